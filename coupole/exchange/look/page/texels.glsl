// Materials of texels: where a place of a triangle lies in the maps, and what they have there.

uniform bool has_texels;
uniform usampler2D map_places;
uniform sampler2D texel_shape;  // normal's octahedron in 12 + 12 bits, root of alpha from 1 to 255; 0 for none
uniform sampler2DArray texel_colours;  // kd and ks over their peaks
uniform vec2 texel_peaks;

const uint NOWHERE = 0xFFFFFFFFu;

struct Material {
  vec3 normal;
  vec3 kd;
  vec3 ks;
  float alpha;  // 0 where there is none
};

vec2 corner_in_maps(uint code) {
  return vec2(code & 0xFFFFu, code >> 16) / 65535.0;
}

// Shares of the three corners of a triangle at a place of its plane.
vec3 shares_of_corners(int triangle, vec3 at_mm) {
  uvec3 corners = texelFetch(triangles, cell(triangle), 0).xyz;
  vec3 first = place_mm(corners.x), one = place_mm(corners.y) - first, other = place_mm(corners.z) - first;
  vec3 across = cross(one, other), way = at_mm - first;
  float square = max(dot(across, across), 1e-20);
  float v = dot(cross(way, other), across) / square, w = dot(cross(one, way), across) / square;
  return vec3(1.0 - v - w, v, w);
}

Material texels_at(int triangle, vec3 at_mm) {
  Material material = Material(vec3(0.0), vec3(0.0), vec3(0.0), 0.0);
  if (!has_texels) return material;
  uvec3 codes = texelFetch(map_places, cell(triangle), 0).xyz;
  if (codes.x == NOWHERE) return material;
  vec3 shares = shares_of_corners(triangle, at_mm);
  vec2 place = shares.x * corner_in_maps(codes.x) + shares.y * corner_in_maps(codes.y) + shares.z * corner_in_maps(codes.z);
  ivec2 size = textureSize(texel_shape, 0);
  vec2 texel = place * vec2(size) - 0.5;
  ivec2 corner = ivec2(floor(texel));
  vec2 part = texel - vec2(corner);
  float total = 0.0, root = 0.0;
  for (int k = 0; k < 4; k++) {
    ivec2 next = ivec2(k % 2, k / 2);
    vec4 code = round(255.0 * texelFetch(texel_shape, clamp(corner + next, ivec2(0), size - 1), 0));
    if (code.a == 0.0) continue;
    vec2 weights = mix(1.0 - part, part, vec2(next));
    float weight = weights.x * weights.y;
    vec2 low = vec2(floor(code.b / 16.0), mod(code.b, 16.0));
    material.normal += weight * unfolded((16.0 * code.rg + low) / 4095.0 * 2.0 - 1.0);
    root += weight * (code.a - 1.0) / 254.0;
    total += weight;
  }
  if (total < 0.25) return material;
  material.normal = normalize(material.normal);
  material.kd = texel_peaks.x * texture(texel_colours, vec3(place, 0.0)).rgb;
  material.ks = texel_peaks.y * texture(texel_colours, vec3(place, 1.0)).rgb;
  material.alpha = max(root * root / (total * total), 1e-3);
  return material;
}
