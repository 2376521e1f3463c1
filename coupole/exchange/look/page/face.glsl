// The flat face of clear lacquer over flakes, and ways of light through it.

uniform bool has_face;
uniform vec3 face_normal;
uniform float face_mm;  // its height along the normal
uniform float face_index;
uniform int flakes;  // number of their first material, -1 for none
uniform int under_flakes;  // number of the material below them
uniform vec3 eye_mm;

float depth_mm(vec3 at_mm) {
  return has_face ? face_mm - dot(at_mm, face_normal) : 0.0;
}

// Where light from a place under the face comes out on its way to the eye: Snell's law, by repeated substitution.
vec3 exit_mm(vec3 at_mm) {
  float depth = depth_mm(at_mm), height = dot(eye_mm, face_normal) - face_mm;
  vec3 along = eye_mm - at_mm;
  along -= face_normal * dot(along, face_normal);
  float apart = length(along), gone = 0.0;
  if (apart > 0.0) along /= apart;
  for (int k = 0; k < 5; k++) {
    float rest = apart - gone;
    float sine = rest / sqrt(rest * rest + height * height) / face_index;
    gone = depth * sine / sqrt(1.0 - sine * sine);
  }
  return at_mm + depth * face_normal + gone * along;
}

// The way to a light in air, or to the eye, as it is in the lacquer.
vec3 inside(vec3 way) {
  vec3 across = (way - face_normal * dot(way, face_normal)) / face_index;
  return across + face_normal * sqrt(1.0 - dot(across, across));
}

// Share of unpolarised light that the face reflects.
float reflected(float cosine) {
  float g = sqrt(face_index * face_index - 1.0 + cosine * cosine);
  float s = (cosine - g) / (cosine + g), p = (face_index * face_index * cosine - g) / (face_index * face_index * cosine + g);
  return 0.5 * (s * s + p * p);
}
