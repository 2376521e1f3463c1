// Radiance of a scene's pixels, white 1: layers of facets (GGX) over bodies, whose colours stand in tables for each
// illuminant. One sample of each light; the mean with the samples before is written.

const int RELIT = 0, DIFFUSE = 1, SPECULAR = 2, NORMALS = 4, ROUGHNESS = 5;
const int ANGLES = 33, LAYERS = 2;

uniform usampler2D seen;
uniform usampler2D before;
uniform usampler2D material;
uniform sampler2D tables;
uniform int materials;

uniform int mode;
uniform float share;  // of this sample in the mean
uniform mat3 view_from_object;

uniform int lights;  // the sky is the last of them, if there is one
uniform vec3 ways[MOST];
uniform float strengths[MOST];
uniform int sources[MOST];  // their illuminants
uniform vec3 middles[MOST];  // of their disks
uniform float least_cosines[MOST];  // of their disks' rims
uniform float sky;
uniform vec2 picked;  // a direction of this sample, 0 to 1 each

uniform int paths;
uniform float longest_mm;

out uvec4 mean;

struct Place {
  int number;  // of its material
  float share;  // of the first layer
  vec3 at_mm;
  vec3 normal;
  vec3 face;
};

int row_of(int source, int number, int layer) {
  return (source * materials + number) * LAYERS + layer;
}

// Mirror reflectance, and what passes the face.
vec4 at_cosine(int row, float cosine) {
  float at = sqrt(clamp(cosine, 0.0, 1.0)) * float(ANGLES - 1);
  int low = min(int(at), ANGLES - 2);
  return mix(texelFetch(tables, ivec2(low, row), 0), texelFetch(tables, ivec2(low + 1, row), 0), at - float(low));
}

// Of body and roughness.
vec4 body_of(int row) {
  return texelFetch(tables, ivec2(ANGLES, row), 0);
}

float weight_of(Place place, int layer) {
  bool is_drawn = texelFetch(tables, ivec2(ANGLES + 1, row_of(0, place.number, layer)), 0).x > 0.0;
  return !is_drawn ? 1.0 : layer == 0 ? place.share : 1.0 - place.share;
}

// 1/sr; without facets for the sky, whose mirror image is sampled by the facets.
vec3 reflectance(Place place, int source, vec3 way, vec3 view, bool has_facets) {
  float nl = dot(place.normal, way), nv = dot(place.normal, view);
  vec3 half_way = normalize(way + view), sum = vec3(0.0);
  if (nl <= 0.0 || nv <= 0.0) return sum;
  for (int layer = 0; layer < LAYERS; layer++) {
    int row = row_of(source, place.number, layer);
    vec4 body = body_of(row);
    vec3 value = vec3(0.0);
    if (has_facets && mode != DIFFUSE) {
      value += at_cosine(row, dot(half_way, way)).rgb * lobe(nl, nv, dot(place.normal, half_way), body.a);
    }
    if (mode != SPECULAR) value += body.rgb * at_cosine(row, nl).a * at_cosine(row, nv).a;
    sum += weight_of(place, layer) * value;
  }
  return sum;
}

// A normal of GGX facets about another one, by their density.
vec3 facet(vec3 normal, float alpha) {
  float height = sqrt((1.0 - picked.x) / (1.0 + (alpha * alpha - 1.0) * picked.x));
  float reach = sqrt(max(1.0 - height * height, 0.0)), angle = 2.0 * PI * picked.y;
  vec3 first = normalize(cross(abs(normal.z) < 0.9 ? vec3(0.0, 0.0, 1.0) : vec3(1.0, 0.0, 0.0), normal));
  return normalize(reach * (cos(angle) * first + sin(angle) * cross(normal, first)) + height * normal);
}

// The lobe times the cosine to the light, over the density of `facet`.
float weight_of_facet(float alpha, float nl, float nv, float nh, float vh) {
  float square = alpha * alpha;
  float a = sqrt(square + (1.0 - square) * nl * nl), b = sqrt(square + (1.0 - square) * nv * nv);
  return 2.0 * nl * vh / (nh * (nl * b + nv * a));
}

// The sky's mirror image in facets.
vec3 mirrored_sky(Place place, int source, vec3 view) {
  vec3 sum = vec3(0.0);
  float nv = dot(place.normal, view);
  if (nv <= 0.0) return sum;
  for (int layer = 0; layer < LAYERS; layer++) {
    int row = row_of(source, place.number, layer);
    float alpha = body_of(row).a;
    vec3 small = facet(place.normal, alpha), way = reflect(-view, small);
    float nl = dot(place.normal, way), nh = dot(place.normal, small), vh = dot(view, small);
    if (nl <= 0.0 || vh <= 0.0 || way.z <= 0.0) continue;
    sum += weight_of(place, layer) * at_cosine(row, vh).rgb * weight_of_facet(alpha, nl, nv, nh, vh);
  }
  return sky * sum;
}

vec3 in_air(Place place) {
  vec3 view = normalize(eye_mm - place.at_mm), sum = vec3(0.0);
  for (int light = 0; light < lights; light++) {
    bool is_sky = sky > 0.0 && light == lights - 1;
    if (is_sky && mode != DIFFUSE) sum += mirrored_sky(place, sources[light], view);
    float nl = dot(place.normal, ways[light]);
    if (nl <= 0.0 || dot(place.face, ways[light]) <= 0.0) continue;
    float share = reaching(light, place.at_mm + place.face * offset_mm[light]);
    sum += strengths[light] * nl * share * reflectance(place, sources[light], ways[light], view, !is_sky);
  }
  return sum;
}

// What a white has under an illuminant.
vec3 white_of(int source) {
  return texelFetch(tables, ivec2(ANGLES + 1, row_of(source, 0, 0)), 0).yzw;
}

// Mirror reflectance of a flake behind a way through lacquer.
vec3 flake_mirror(int source, float cosine, float way_mm) {
  float at = clamp(way_mm / longest_mm, 0.0, 1.0) * float(paths - 1);
  int low = min(int(at), paths - 2);
  vec3 first = at_cosine(row_of(source, flakes + low, 0), cosine).rgb;
  return mix(first, at_cosine(row_of(source, flakes + low + 1, 0), cosine).rgb, at - float(low));
}

// A flake's mirror, or the body below, 1/sr.
vec3 under_reflectance(Place place, int source, vec3 way, vec3 view, float way_mm) {
  if (place.number != flakes) return reflectance(place, source, way, view, true);
  float nl = dot(place.normal, way), nv = dot(place.normal, view);
  if (mode == DIFFUSE || nl <= 0.0 || nv <= 0.0) return vec3(0.0);
  vec3 half_way = normalize(way + view);
  float alpha = body_of(row_of(0, flakes, 0)).a;
  return flake_mirror(source, dot(half_way, way), way_mm) * lobe(nl, nv, dot(place.normal, half_way), alpha);
}

// The sky's mirror image in a flake's facets, through the face.
vec3 sky_in_flake(Place place, int source, vec3 view, float passed_out, float depth) {
  float alpha = body_of(row_of(0, flakes, 0)).a, nv = dot(place.normal, view);
  vec3 small = facet(place.normal, alpha), way = reflect(-view, small);
  float nl = dot(place.normal, way), vh = dot(view, small), height_in = dot(way, face_normal);
  vec3 across = face_index * (way - face_normal * height_in);
  if (nv <= 0.0 || nl <= 0.0 || vh <= 0.0 || height_in <= 0.0 || dot(across, across) >= 1.0) return vec3(0.0);
  float height = sqrt(1.0 - dot(across, across));
  if ((across + height * face_normal).z <= 0.0) return vec3(0.0);
  float way_mm = depth / height_in + depth / dot(view, face_normal);
  return sky * passed_out * (1.0 - reflected(height)) * flake_mirror(source, vh, way_mm)
    * weight_of_facet(alpha, nl, nv, dot(place.normal, small), vh);
}

// Under the lacquer's face, and what the face mirrors.
vec3 in_lacquer(Place place) {
  vec3 out_mm = exit_mm(place.at_mm), view = normalize(eye_mm - out_mm), view_in = inside(view), sum = vec3(0.0);
  float depth = depth_mm(place.at_mm), cosine = dot(view, face_normal), mirrored = reflected(cosine);
  vec3 mirror = reflect(-view, face_normal);
  if (dot(place.normal, view_in) < 0.0) place.normal = -place.normal;
  for (int light = 0; light < lights; light++) {
    bool is_sky = sky > 0.0 && light == lights - 1;
    float height = dot(ways[light], face_normal);
    if (is_sky && mode != DIFFUSE && mirror.z > 0.0) sum += mirrored * white_of(sources[light]) * sky;
    if (is_sky && place.number == flakes) {
      if (mode != DIFFUSE) sum += sky_in_flake(place, sources[light], view_in, 1.0 - mirrored, depth);
      continue;
    }
    if (height <= 0.0) continue;
    float share = reaching(light, out_mm + face_normal * offset_mm[light]);
    if (!is_sky && mode != DIFFUSE && least_cosines[light] < 1.0 && dot(mirror, middles[light]) > least_cosines[light]) {
      float over = PI * (1.0 - least_cosines[light] * least_cosines[light]);
      sum += mirrored * share * strengths[light] / over * white_of(sources[light]);
    }
    vec3 way_in = inside(ways[light]);
    float nl = dot(place.normal, way_in), height_in = dot(way_in, face_normal);
    float way_mm = depth / height_in + depth / dot(view_in, face_normal);
    float passed = (1.0 - reflected(height)) * (1.0 - mirrored) / (face_index * face_index) * height / height_in;
    sum += strengths[light] * max(nl, 0.0) * share * passed
      * under_reflectance(place, sources[light], way_in, view_in, way_mm);
  }
  return sum;
}

vec4 looked_at(int triangle, vec3 at_mm) {
  uvec2 code = texelFetch(material, cell(triangle), 0).xy;
  Place place = Place(int(code.x), float(code.y) / 65535.0, at_mm, normal_of(triangle), face_of(triangle));
  if (mode == NORMALS) return vec4(view_from_object * place.normal * 0.5 + 0.5, 1.0);
  if (mode == ROUGHNESS) return vec4(vec3(body_of(row_of(0, place.number, place.share < 0.5 ? 1 : 0)).a), 1.0);
  bool is_under = place.number == flakes || place.number == under_flakes && dot(place.face, face_normal) > 0.99;
  bool is_seen_through = has_face && is_under && dot(eye_mm, face_normal) > face_mm;
  return vec4(is_seen_through ? in_lacquer(place) : in_air(place), 1.0);
}

void main() {
  uvec4 here = texelFetch(seen, ivec2(gl_FragCoord.xy), 0);
  vec4 found = here.w == 0u ? vec4(0.0) : looked_at(int(here.w) - 1, uintBitsToFloat(here.xyz));
  if (share < 1.0) found = mix(uintBitsToFloat(texelFetch(before, ivec2(gl_FragCoord.xy), 0)), found, share);
  mean = bits(found);
}
