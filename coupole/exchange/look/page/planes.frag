// A view of a run: the frame of the nearest LED, or between LEDs by principal components, as share of the camera's
// range. One sample of each light; the mean with the samples before is written.

const int LAYERS = 7;  // of four components each

uniform usampler2D seen;
uniform usampler2D before;
uniform sampler2DArray planes;
uniform sampler2D factors;  // of each light a row: of 1, then of each component; red, green, blue
uniform vec3 strengths[10];
uniform int lights;
uniform int components;
uniform float share;  // of this sample in the mean

uniform bool measured;
uniform sampler2D frame;
uniform float frame_step_px;
uniform float frame_peak;
uniform vec2 picture_px;

out uvec4 mean;

vec3 of_frame(vec2 at) {
  ivec2 size = textureSize(frame, 0);
  ivec2 pixel = clamp(ivec2(vec2(at.x, picture_px.y - at.y) / frame_step_px), ivec2(0), size - 1);
  vec3 shown = texelFetch(frame, pixel, 0).rgb;
  return frame_peak * mix(shown / 12.92, pow((shown + 0.055) / 1.055, vec3(2.4)), step(0.04045, shown));
}

vec3 between(int number) {
  float codes[4 * LAYERS];
  for (int layer = 0; layer < LAYERS; layer++) {
    vec4 four = texelFetch(planes, ivec3(cell(number), layer), 0) * 255.0;
    for (int k = 0; k < 4; k++) codes[4 * layer + k] = four[k];
  }
  vec3 sum = vec3(0.0);
  for (int light = 0; light < lights; light++) {
    vec3 root = texelFetch(factors, ivec2(0, light), 0).rgb;
    for (int k = 0; k < components; k++) root += codes[k] * texelFetch(factors, ivec2(k + 1, light), 0).rgb;
    root = max(root, 0.0);
    sum += strengths[light] * root * root;
  }
  return sum;
}

void main() {
  uvec4 here = texelFetch(seen, ivec2(gl_FragCoord.xy), 0);
  vec4 found = vec4(0.0);
  if (here.w > 0u) found = vec4(measured ? of_frame(uintBitsToFloat(here.xy)) : between(int(here.w) - 1), 1.0);
  if (share < 1.0) found = mix(uintBitsToFloat(texelFetch(before, ivec2(gl_FragCoord.xy), 0)), found, share);
  mean = bits(found);
}
