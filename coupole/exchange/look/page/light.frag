// Radiance of pixels under lights: (n l) (kd + ks D V), GGX's D and the height-correlated V, as the fits have it.
// One sample of each light; the mean with the samples before is written.

const int RELIT = 0, DIFFUSE = 1, SPECULAR = 2, UNSHARP = 3, NORMALS = 4, ROUGHNESS = 5, UNCERTAINTY = 6;
const int TAPS = 24;  // of what relief is compared with
const float RELIEF_PX = 9.0;

uniform usampler2D seen;
uniform usampler2D before;
uniform sampler2D kd;
uniform sampler2D ks;
uniform sampler2D gloss;
uniform usampler2D uncertainty;

uniform int mode;
uniform int quantity;
uniform float relief;
uniform float share;  // of this sample in the mean
uniform vec3 eye_mm;
uniform bool flat_one;  // a measured picture: seen from far above, without shadows
uniform mat3 view_from_object;

uniform int lights;
uniform vec3 ways[MOST];
uniform vec3 irradiances[MOST];

// An LED as it was in the run, in place of the lights; and the frame that the camera took under it.
uniform bool led;
uniform vec3 led_mm;
uniform vec3 led_axis;
uniform float led_exponent;
uniform sampler2D measured;
uniform float measured_peak;
uniform float split_px;
uniform vec3 view_mm;
uniform mat3 view_from_way;
uniform vec2 lens[21];

out uvec4 mean;

struct Material {
  vec3 normal;
  vec3 kd;
  vec3 ks;
  float alpha;
};

// 1/m^2, times a power of the cosine to the LED's axis.
float led_reach(vec3 at_mm, vec3 way) {
  vec3 apart = (led_mm - at_mm) * 1e-3;
  return pow(max(-dot(way, led_axis), 0.0), led_exponent) / dot(apart, apart);
}

// What the measured frame has of a place: share of the camera's range.
vec4 measured_at(vec3 at_mm) {
  vec3 way = view_from_way * (at_mm - view_mm);
  vec2 to = way.xy / way.z, at = vec2(0.0);
  int number = 0;
  float x = 1.0;
  for (int i = 0; i <= 5; i++) {
    float y = x;
    for (int j = 0; j <= 5 - i; j++) {
      at += lens[number++] * y;
      y *= to.y;
    }
    x *= to.x;
  }
  if (any(lessThan(at, vec2(0.0))) || any(greaterThanEqual(at, vec2(1.0)))) return vec4(0.0);
  vec3 code = texelFetch(measured, ivec2(at * vec2(textureSize(measured, 0))), 0).rgb * 255.0;
  if (code.r == 0.0) return vec4(0.0);
  vec3 shown = (code - 1.0) / 254.0;
  vec3 linear = mix(shown / 12.92, pow((shown + 0.055) / 1.055, vec3(2.4)), step(0.04045, shown));
  return vec4(measured_peak * linear, 1.0);
}

// What comes from a place of a material, under all lights.
vec3 radiance(Material material, vec3 at_mm, vec3 face) {
  vec3 view = flat_one ? vec3(0.0, 0.0, 1.0) : normalize(eye_mm - at_mm);
  float nv = dot(material.normal, view);
  vec3 sum = vec3(0.0);
  for (int light = 0; light < lights; light++) {
    vec3 way = led ? normalize(led_mm - at_mm) : ways[light];
    float nl = dot(material.normal, way);
    if (nl <= 0.0 || dot(face, way) <= 0.0) continue;
    vec3 value = mode == SPECULAR ? vec3(0.0) : material.kd;
    if (nv > 0.0 && mode != DIFFUSE) {
      value += material.ks * lobe(nl, nv, dot(material.normal, normalize(way + view)), material.alpha);
    }
    float share = flat_one ? 1.0 : reaching(light, at_mm + face * offset_mm[light]);
    if (led) share *= led_reach(at_mm, way);
    sum += irradiances[light] * nl * value * share;
  }
  return sum;
}

// The normal, turned away from the mean of those around it.
vec3 in_relief(vec3 normal) {
  vec3 around = vec3(0.0);
  for (int tap = 0; tap < TAPS; tap++) {
    float reach = RELIEF_PX * sqrt((float(tap) + 0.5) / float(TAPS)), angle = 2.39996323 * float(tap);
    ivec2 at = ivec2(gl_FragCoord.xy + reach * vec2(cos(angle), sin(angle)));
    if (any(lessThan(at, ivec2(0))) || any(greaterThanEqual(at, textureSize(seen, 0)))) continue;
    uint other = texelFetch(seen, at, 0).w;
    around += other > 0u ? normal_of(int(other) - 1) : vec3(0.0);
  }
  return normalize(normal + relief * (normal - normalize(around + 1e-6 * normal)));
}

vec4 looked_at(int triangle, vec3 at_mm) {
  if (led && mode <= UNSHARP && gl_FragCoord.x < split_px) return measured_at(at_mm);
  vec2 shine = texelFetch(gloss, cell(triangle), 0).xy;
  if (shine.x == 0.0) return vec4(0.0);
  Material material = Material(
    normal_of(triangle), texelFetch(kd, cell(triangle), 0).rgb, texelFetch(ks, cell(triangle), 0).rgb, shine.x
  );
  if (mode == UNSHARP) material.normal = in_relief(material.normal);
  if (mode == NORMALS) return vec4(view_from_object * material.normal * 0.5 + 0.5, 1.0);
  if (mode == ROUGHNESS) return vec4(vec3(shine.x), 1.0);
  if (mode == UNCERTAINTY) {
    uint code = texelFetch(uncertainty, cell(triangle), 0)[quantity];
    return code == 0u ? vec4(0.0) : vec4(vec3(1e-4 * pow(1e5, (float(code) - 1.0) / 254.0)), 1.0);
  }
  if (mode > UNCERTAINTY) return vec4(vec3(shine.y), 1.0);
  return vec4(radiance(material, at_mm, flat_one ? material.normal : face_of(triangle)), 1.0);
}

void main() {
  uvec4 here = texelFetch(seen, ivec2(gl_FragCoord.xy), 0);
  vec4 found = here.w == 0u ? vec4(0.0) : looked_at(int(here.w) - 1, uintBitsToFloat(here.xyz));
  if (share < 1.0) found = mix(uintBitsToFloat(texelFetch(before, ivec2(gl_FragCoord.xy), 0)), found, share);
  mean = bits(found);
}
