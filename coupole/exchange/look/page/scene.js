// A described scene: layers whose colours come from tables, one for each illuminant. No number of it was measured.

const SCENE_FIELDS = {
  places: ["uint16", 3], triangles: ["uint32", 3], normals: ["uint16", 2], material: ["uint16", 2],
};
const COLUMNS = 35, LAYERS = 2, ANGLES = 33;
const SOURCES = Object.keys(ILLUMINANTS);

class SceneRenderer extends Renderer {
  get surfaceShader() {
    return "scene.vert";
  }

  get lightShader() {
    return "scene.frag";
  }

  fieldsOf() {
    return SCENE_FIELDS;
  }

  take(arrays) {
    super.take(arrays);
    const { gl } = this;
    this.textures.tables = plainTexture(gl, gl.TEXTURE_2D);
    const [inside, format, type] = formatOf(gl, "float32", 4), rows = arrays.tables.length / 4 / COLUMNS;
    gl.texImage2D(gl.TEXTURE_2D, 0, inside, COLUMNS, rows, 0, format, type, arrays.tables);
  }

  /** What casts shadows is smaller than the sheets that it stands on. */
  measure() {
    super.measure();
    const [low, high] = this.about.casting_mm;
    this.casting = { middle: times(add(low, high), 0.5), radius: Math.max(length(minus(high, low)) / 2, 1e-6) };
  }

  get castingRadius() {
    return this.casting.radius;
  }

  /** Across the light only what casts, along it all of the scene. */
  shadowMatrix(way) {
    const { middle } = this.casting, [right, up] = across(way), reach = this.castingRadius * 1.01;
    const far = length(minus(middle, this.middle)) + this.radius * 1.01;
    return product(orthographic(reach, reach, 0, 2 * far), lookingFrom(add(middle, times(way, far)), right, up, way));
  }

  frameOf() {
    return null;
  }

  beamsOf(state) {
    const beams = state.lights.map((light, number) => ({
      way: sampledDirection(light, this.samples, number), strength: this.about.irradiance * light.strength,
      source: SOURCES.indexOf(light.illuminant), middle: unit(light.direction),
      leastCosine: light.softness ? Math.cos(radians(light.softness)) : 1,
    }));
    if (state.sky > 0) {
      const { way, irradiance: [strength] } = sampledSky(state.sky, this.samples);
      beams.push({ way, strength, source: SOURCES.indexOf(state.skyIlluminant), middle: way, leastCosine: 1 });
    }
    return beams.map((beam) => ({ ...beam, shadow: this.shadowMatrix(beam.way) }));
  }

  useSurface(camera) {
    const { places, triangles, material } = this.textures;
    const at = this.use("surface", { places, triangles, material });
    this.gl.uniform3fv(at("eye_mm"), axesOf(camera).place);
    this.setFace(at);
    return at;
  }

  setFace(at) {
    const { gl, about: { face } } = this;
    gl.uniform1i(at("has_face"), face ? 1 : 0);
    gl.uniform1i(at("flakes"), face?.flakes ?? -1);
    gl.uniform1i(at("under_flakes"), face?.body ?? -1);
    if (!face) return;
    gl.uniform3fv(at("face_normal"), face.normal);
    gl.uniform1f(at("face_mm"), face.height_mm);
    gl.uniform1f(at("face_index"), face.index);
    gl.uniform1i(at("paths"), face.paths);
    gl.uniform1f(at("longest_mm"), face.longest_mm);
  }

  drawLight(state, beams) {
    const { gl, targets: { seen, mean } } = this;
    const at = this.use("light", {
      ...this.textures, seen: seen.texture, before: mean.texture, shadows: this.depths.texture,
    });
    this.setFace(at);
    gl.uniform1i(at("materials"), this.about.materials.length);
    gl.uniform1fv(at("strengths"), beams.map(({ strength }) => strength));
    gl.uniform1iv(at("sources"), beams.map(({ source }) => source));
    gl.uniform3fv(at("middles"), beams.flatMap(({ middle }) => middle));
    gl.uniform1fv(at("least_cosines"), beams.map(({ leastCosine }) => leastCosine));
    gl.uniform1f(at("sky"), state.sky);
    gl.uniform2fv(at("picked"), evenly(this.samples));
    this.drawMean(at, state, beams);
  }

  /** What has to be said of the picture, wherever it is seen. */
  banner(state) {
    const told = [`Hypothesis: ${this.about.scene}, simulated, never measured`];
    if (isLit(state.mode)) {
      const used = [...new Set(state.lights.filter(({ strength }) => strength > 0).map(({ illuminant }) => illuminant))];
      if (state.sky > 0 && !used.includes(state.skyIlluminant)) used.push(state.skyIlluminant);
      told.push(`reflectance by spectra under ${used.join(", ")}`);
      told.push(state.adapted ? "eye adapted to the chosen light (Bradford)" : "no adaptation of the eye");
      told.push("no light from surface to surface");
    }
    if (isStereo(state)) told.push("for two eyes: the left eye's picture is on the left");
    return told.join(" · ");
  }

  /** What a place is made of, as markup. */
  toldAt({ place, triangle }) {
    const { material, tables } = this.arrays, number = material[2 * triangle], count = this.about.materials.length;
    const share = material[2 * triangle + 1] / 65535;
    const rows = SOURCES.map((name, source) => {
      const first = 4 * COLUMNS * LAYERS * (source * count + number), at = first + 4 * (ANGLES - 1);
      return `<dt>${escaped(name)}</dt><dd>${three([...tables.subarray(at, at + 3)])}</dd>`;
    });
    const isDrawn = tables[4 * (COLUMNS * LAYERS * number + ANGLES + 1)] > 0;
    return `<p>${escaped(this.about.materials[number])}${isDrawn ? `; share of the metal ${percent(share)}` : ""}</p>
      <p class="small">At ${place.map((one) => one.toFixed(2)).join(", ")} mm. Mirror reflectance of its first layer
      along the normal, linear sRGB without adaptation, of white 1:</p><dl>${rows.join("")}</dl>`;
  }
}
