#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;
precision highp sampler2DArray;

// Numbers of the object lie in rows of this many.
const int ROW = 4096;

uniform usampler2D places;
uniform usampler2D triangles;
uniform vec3 origin_mm;
uniform float step_mm;

ivec2 cell(int number) {
  return ivec2(number % ROW, number / ROW);
}

vec3 place_mm(uint number) {
  return origin_mm + step_mm * vec3(texelFetch(places, cell(int(number)), 0).xyz);
}

// Floats are written as their bits: every browser can draw into textures of integers.
uvec4 bits(vec4 values) {
  return floatBitsToUint(values);
}
