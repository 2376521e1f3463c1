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

// What GGX leaves of triangles, as one view saw it: three shares of GGX, then numbers of planes, four to a layer.
uniform sampler2DArray residual;
uniform sampler2DArray residual_planes;  // by the light's direction in the triangle's frame
uniform int residual_count;  // planes, 0 for none
uniform vec3 residual_mm;  // the camera of its view
uniform vec2 residual_cosines;  // between the eye and that camera: all of it, none of it

out uvec4 mean;

// What a place of a triangle is made of: of texels where there are any, else of the triangle.
Material material_at(int triangle, vec3 at_mm) {
  Material material = texels_at(triangle, at_mm);
  if (material.alpha > 0.0) return material;
  float alpha = texelFetch(gloss, cell(triangle), 0).x;
  if (alpha == 0.0) return material;
  return Material(
    normal_of(triangle), texelFetch(kd, cell(triangle), 0).rgb, texelFetch(ks, cell(triangle), 0).rgb, alpha
  );
}

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

float residual_code(int triangle, int number) {
  return 255.0 * texelFetch(residual, ivec3(cell(triangle), number / 4), 0)[number % 4];
}

// Share of the residual that is shown to the eye; 0 of triangles that have none.
float residual_share(int triangle, vec3 view, vec3 at_mm) {
  if (residual_count == 0 || residual_code(triangle, 0) == 0.0) return 0.0;
  float cosine = dot(view, normalize(residual_mm - at_mm));
  return smoothstep(residual_cosines.y, residual_cosines.x, cosine);
}

// Where the tables have a light's direction: Lambert's azimuthal projection in the frame of the mesh's normal and, along
// the surface, the view's camera.
vec2 residual_place(vec3 way, vec3 face, vec3 at_mm) {
  vec3 along = residual_mm - at_mm;
  along -= face * dot(along, face);
  along = length(along) > 1e-6 ? normalize(along) : normalize(abs(face.x) < 0.6 ? vec3(1, 0, 0) - face * face.x : vec3(0, 1, 0) - face * face.y);
  vec2 disk = vec2(dot(way, along), dot(way, cross(face, along))) / sqrt(1.0 + max(dot(way, face), 0.0));
  float side = float(textureSize(residual_planes, 0).x);
  return (0.5 * (disk + 1.0) * (side - 1.0) + 0.5) / side;
}

// Reflectance times cosine: a share of that of GGX, and the planes.
vec3 with_residual(vec3 ggx, int triangle, vec3 way, vec3 face, vec3 at_mm) {
  vec2 place = residual_place(way, face, at_mm);
  vec3 shares, sum = vec3(0.0);
  for (int k = 0; k < 3; k++) shares[k] = (residual_code(triangle, k) - 1.0) / 254.0;
  for (int k = 0; k < residual_count; k++) {
    float root = (residual_code(triangle, k + 3) - 128.0) / 127.0;
    sum += root * abs(root) * texture(residual_planes, vec3(place, k)).rgb;
  }
  return max(shares * ggx + dot(way, face) * sum, 0.0);
}

// What comes from a place of a material, under all lights.
vec3 radiance(Material material, int triangle, vec3 at_mm, vec3 face) {
  vec3 view = flat_one ? vec3(0.0, 0.0, 1.0) : normalize(eye_mm - at_mm);
  float added = residual_share(triangle, view, at_mm);
  float nv = dot(material.normal, view);
  vec3 sum = vec3(0.0);
  for (int light = 0; light < lights; light++) {
    vec3 way = led ? normalize(led_mm - at_mm) : ways[light];
    float nl = dot(material.normal, way);
    if (nl <= 0.0 && added == 0.0 || dot(face, way) <= 0.0) continue;
    vec3 value = mode == SPECULAR ? vec3(0.0) : material.kd;
    if (nl > 0.0 && nv > 0.0 && mode != DIFFUSE) {
      value += material.ks * lobe(nl, nv, dot(material.normal, normalize(way + view)), material.alpha);
    }
    float share = flat_one ? 1.0 : reaching(light, at_mm + face * offset_mm[light]);
    if (led) share *= led_reach(at_mm, way);
    value *= max(nl, 0.0);
    if (added > 0.0) value = mix(value, with_residual(value, triangle, way, face, at_mm), added);
    sum += irradiances[light] * value * share;
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
    uvec4 other = texelFetch(seen, at, 0);
    around += other.w > 0u ? material_at(int(other.w) - 1, uintBitsToFloat(other.xyz)).normal : vec3(0.0);
  }
  return normalize(normal + relief * (normal - normalize(around + 1e-6 * normal)));
}

vec4 looked_at(int triangle, vec3 at_mm) {
  if (led && mode <= UNSHARP && gl_FragCoord.x < split_px) return measured_at(at_mm);
  Material material = material_at(triangle, at_mm);
  if (material.alpha == 0.0) return vec4(0.0);
  if (mode == UNSHARP) material.normal = in_relief(material.normal);
  if (mode == NORMALS) return vec4(view_from_object * material.normal * 0.5 + 0.5, 1.0);
  if (mode == ROUGHNESS) return vec4(vec3(material.alpha), 1.0);
  if (mode == UNCERTAINTY) {
    uint code = texelFetch(uncertainty, cell(triangle), 0)[quantity];
    return code == 0u ? vec4(0.0) : vec4(vec3(1e-4 * pow(1e5, (float(code) - 1.0) / 254.0)), 1.0);
  }
  if (mode > UNCERTAINTY) return vec4(vec3(texelFetch(gloss, cell(triangle), 0).y), 1.0);
  return vec4(radiance(material, triangle, at_mm, flat_one ? material.normal : face_of(triangle)), 1.0);
}

void main() {
  uvec4 here = texelFetch(seen, ivec2(gl_FragCoord.xy), 0);
  vec4 found = here.w == 0u ? vec4(0.0) : looked_at(int(here.w) - 1, uintBitsToFloat(here.xyz));
  if (share < 1.0) found = mix(uintBitsToFloat(texelFetch(before, ivec2(gl_FragCoord.xy), 0)), found, share);
  mean = bits(found);
}
