// Radiance of pixels under lights: (n l) (kd + ks D V), GGX's D and the height-correlated V, as the fits have it.
// One sample of each light; the mean with the samples before is written.

const float PI = 3.14159265358979;
const int MOST = 11;  // the user's ten lights, and the sky
const int RELIT = 0, DIFFUSE = 1, SPECULAR = 2, UNSHARP = 3, NORMALS = 4, ROUGHNESS = 5, UNCERTAINTY = 6;
const int TAPS = 24;  // of what relief is compared with
const float RELIEF_PX = 9.0;

uniform usampler2D seen;
uniform usampler2D before;
uniform usampler2D normals;
uniform sampler2D kd;
uniform sampler2D ks;
uniform sampler2D gloss;
uniform usampler2D uncertainty;
uniform sampler2DArray shadows;

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
uniform mat4 shadow_from_object[MOST];
uniform float offset_mm[MOST];  // from a surface to where its shadow is looked for

out uvec4 mean;

struct Material {
  vec3 normal;
  vec3 kd;
  vec3 ks;
  float alpha;
};

vec3 normal_of(int triangle) {
  vec2 square = vec2(texelFetch(normals, cell(triangle), 0).xy) / 65535.0 * 2.0 - 1.0;
  vec3 normal = vec3(square, 1.0 - abs(square.x) - abs(square.y));
  vec2 folded = (1.0 - abs(normal.yx)) * vec2(normal.x >= 0.0 ? 1.0 : -1.0, normal.y >= 0.0 ? 1.0 : -1.0);
  normal.xy = normal.z < 0.0 ? folded : normal.xy;
  return normalize(normal);
}

vec3 face_of(int triangle) {
  uvec3 corners = texelFetch(triangles, cell(triangle), 0).xyz;
  vec3 first = place_mm(corners.x);
  return normalize(cross(place_mm(corners.y) - first, place_mm(corners.z) - first));
}

float lobe(float nl, float nv, float nh, float alpha) {
  float square = alpha * alpha;
  float t = nh * nh * (square - 1.0) + 1.0;
  float a = sqrt(square + (1.0 - square) * nl * nl);
  float b = sqrt(square + (1.0 - square) * nv * nv);
  return 0.5 * square / (PI * t * t * (nl * b + nv * a));
}

// Share of a light that comes to a place, of the four nearest texels of its depths.
float reaching(int light, vec3 at_mm) {
  vec4 clip = shadow_from_object[light] * vec4(at_mm, 1.0);
  vec3 inside = clip.xyz / clip.w * 0.5 + 0.5;
  ivec2 size = textureSize(shadows, 0).xy;
  vec2 texel = inside.xy * vec2(size) - 0.5;
  ivec2 corner = ivec2(floor(texel));
  vec2 part = texel - vec2(corner);
  float found = 0.0;
  for (int k = 0; k < 4; k++) {
    ivec2 next = ivec2(k % 2, k / 2);
    ivec2 at = clamp(corner + next, ivec2(0), size - 1);
    vec2 weight = mix(1.0 - part, part, vec2(next));
    found += weight.x * weight.y * step(inside.z, texelFetch(shadows, ivec3(at, light), 0).r);
  }
  return found;
}

// What comes from a place of a material, under all lights.
vec3 radiance(Material material, vec3 at_mm, vec3 face) {
  vec3 view = flat_one ? vec3(0.0, 0.0, 1.0) : normalize(eye_mm - at_mm);
  float nv = dot(material.normal, view);
  vec3 sum = vec3(0.0);
  for (int light = 0; light < lights; light++) {
    vec3 way = ways[light];
    float nl = dot(material.normal, way);
    if (nl <= 0.0 || dot(face, way) <= 0.0) continue;
    vec3 value = mode == SPECULAR ? vec3(0.0) : material.kd;
    if (nv > 0.0 && mode != DIFFUSE) {
      value += material.ks * lobe(nl, nv, dot(material.normal, normalize(way + view)), material.alpha);
    }
    float share = flat_one ? 1.0 : reaching(light, at_mm + face * offset_mm[light]);
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
