// The mean on the screen: radiance over white in sRGB, a number by a ramp of colours, normals as they are.

const int RADIANCE = 0, NORMAL = 1, NUMBER = 2;
const int STOPS = 6;
const float HATCH_PX = 7.0;

uniform usampler2D mean;
uniform usampler2D seen;
uniform int kind;
uniform float white;
uniform mat3 adapted;  // of linear red, green, blue
uniform vec2 range;  // of numbers, from and to
uniform bool logarithmic;
uniform vec3 ramp[STOPS];  // sRGB
uniform vec3 ground;

out vec4 colour;

vec3 shown(vec3 linear) {
  vec3 value = clamp(linear, 0.0, 1.0);
  return mix(12.92 * value, 1.055 * pow(value, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, value));
}

vec3 of_number(float number) {
  float share = (number - range.x) / (range.y - range.x);
  if (logarithmic) share = log(number / range.x) / log(range.y / range.x);
  float at = clamp(share, 0.0, 1.0) * float(STOPS - 1);
  int stop = min(int(at), STOPS - 2);
  return mix(ramp[stop], ramp[stop + 1], at - float(stop));
}

void main() {
  ivec2 pixel = ivec2(gl_FragCoord.xy);
  vec4 found = uintBitsToFloat(texelFetch(mean, pixel, 0));
  uint here = texelFetch(seen, pixel, 0).w;
  vec3 behind = ground;
  if (here > 0u && found.a < 0.5) {  // seen by the page, never by the instrument
    float line = mod(gl_FragCoord.x + gl_FragCoord.y, HATCH_PX) < 1.2 ? 0.16 : 0.06;
    behind = ground + (ground.g > 0.5 ? -line : line);
  }
  vec3 front = found.rgb / max(found.a, 1e-6);
  if (kind == RADIANCE) front = shown(adapted * front / white);
  if (kind == NUMBER) front = of_number(front.r);
  colour = vec4(mix(behind, front, clamp(found.a, 0.0, 1.0)), 1.0);
}
