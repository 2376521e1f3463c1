// A run that nothing was fitted to: its frames, and its views between the LEDs.

const PLANE_LAYERS = 7;
const KEPT_FRAMES = 24;

class RunRenderer extends FlatRenderer {
  constructor(canvas, about, arrays) {
    super(canvas, about, arrays);
    this.bases = Object.fromEntries(about.views.map((view) => [view.name, arrays[view.lights]]));
  }

  viewShown(state) {
    return viewOf(this.about, state.view) ?? this.about.views[0];
  }

  get lightShader() {
    return "planes.frag";
  }

  prepareTiles() {
    const gl = this.gl;
    this.textures = this.bodies[0].textures = { planes: layersTexture(gl, PLANE_LAYERS, TILE_ROWS * SLOTS), factors: factorsTexture(gl) };
  }

  surfaceTextures() {
    return { gloss: this.textures.factors };
  }

  /** `codes` [planes, 256, 256] of a tile. */
  keepTile(slot, codes) {
    for (let layer = 0; layer < PLANE_LAYERS; layer++) {
      const four = new Uint8Array(4 * TILE_NUMBERS);
      for (let field = 0; field < 4; field++) {
        const first = (4 * layer + field) * TILE_NUMBERS;
        const plane = codes.subarray(first, first + TILE_NUMBERS);
        for (let k = 0; k < plane.length; k++) four[4 * k + field] = plane[k];
      }
      putLayer(this.gl, this.textures.planes, layer, slot * TILE_ROWS, four);
    }
  }

  /** The frame of the LED nearest to the chosen light, and its texture if it is here. */
  nearestTo(state) {
    const view = this.viewShown(state), way = unit(state.lights[state.chosen].direction);
    const frame = view.frames.reduce((best, one) => dot(one.way, way) > dot(best.way, way) ? one : best);
    return { view, frame, texture: this.frames[frame.block], apart: angleOf(frame.way, way) };
  }

  frameOf(state) {
    return state.mode === "measured" ? this.nearestTo(state) : null;
  }

  keepFrame(frame, bytes) {
    const kept = Object.keys(this.frames);
    if (kept.length >= KEPT_FRAMES) {
      this.gl.deleteTexture(this.frames[kept[0]]);
      delete this.frames[kept[0]];
    }
    super.keepFrame(frame, bytes);
  }

  whiteOf(state) {
    return [state.white || 1, this.about.unit];
  }

  beamsOf(state) {
    return state.lights.map((light, number) => ({
      way: sampledDirection(light, this.samples, number), irradiance: irradiance(light, this.about.irradiance),
    }));
  }

  drawLight(state, beams) {
    const gl = this.gl, { seen, mean, other } = this.targets, found = this.frameOf(state);
    const view = this.viewShown(state), { planes, factors } = this.textures;
    putFactors(gl, factors, beams.map(({ way }) => factorsOf(view, this.bases[view.name], way)));
    const at = this.use("light", {
      seen: seen.texture, before: mean.texture, planes, factors, frame: found?.texture ?? factors,
    });
    gl.uniform1f(at("share"), 1 / (this.samples + 1));
    gl.uniform1i(at("measured"), found?.texture ? 1 : 0);
    gl.uniform1i(at("components"), view.planes);
    gl.uniform1i(at("lights"), beams.length);
    gl.uniform3fv(at("strengths"), beams.flatMap((beam) => beam.irradiance));
    gl.uniform2f(at("picture_px"), ...view.picture_px);
    gl.uniform1f(at("frame_step_px"), view.frame_step_px);
    gl.uniform1f(at("frame_peak"), found?.frame.peak ?? 1);
    gl.bindFramebuffer(gl.FRAMEBUFFER, other.frame);
    gl.disable(gl.DEPTH_TEST);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.enable(gl.DEPTH_TEST);
  }

  banner(state) {
    const told = [this.about.simulated ? "Simulated run" : "Measured run"], { frame, texture, apart } = this.nearestTo(state);
    if (texture && state.mode === "measured") {
      told.push(`frame under LED ${frame.led}, proven`);
    } else {
      told.push("interpolated between frames: a hypothesis");
      told.push(...coloursTold(this.about, state));
      if (apart > this.viewShown(state).apart_deg) told.push("beyond the LEDs");
    }
    return told.join(" · ");
  }

  /** LEDs for the sphere: where they are, and what there is of them. */
  dome(state) {
    const { frames, unproven, hidden } = this.viewShown(state);
    return { proven: frames.map(({ way }) => way), unproven, hidden, nearest: this.nearestTo(state).frame.way };
  }

  /** What is told of the shot that is shown, as markup. */
  shotTold(state) {
    const { view, frame, apart } = this.nearestTo(state), row = (name, text) => `<dt>${name}</dt><dd>${text}</dd>`;
    const away = apart < 0.05 ? "" : `, ${apart.toFixed(1)}° from the light`;
    return `<dl>${row("Nearest", `LED ${frame.led}${away}`)}${row("Shot", `${escaped(frame.shot)}, proven`)}
      ${row("Exposure", `${frame.exposure_us} µs; shares as at ${view.shortest_us} µs`)}
      ${row("View", `${view.proven} of ${view.shots} shots under single LEDs are proven`)}
      ${row("LEDs", `${view.frames.length} with a frame, ${view.unproven.length} without, ${
        view.hidden.length} hidden by arm or object`)}</dl>`;
  }
}

const angleOf = (one, other) => degrees(Math.acos(clamp(dot(unit(one), unit(other)), -1, 1)));

const escaped = (text) => text.replace(/[&<>"]/g, (letter) => `&#${letter.charCodeAt(0)};`);

/** Of 1 and of the codes of each component, red, green and blue: their sum is the root of a pixel's share. */
function factorsOf(view, bases, way) {
  const { frames, planes, low, step } = view, size = 3 * (planes + 1), sums = new Float64Array(size);
  const take = (row, factor) => {
    for (let k = 0; k < size; k++) sums[k] += factor * bases[row * size + k];
  };
  frames.forEach((frame, number) => {
    const square = minus(way, frame.way).reduce((sum, value) => sum + value * value, 0);
    if (square > 0) take(number, 0.5 * square * Math.log(square));
  });
  [1, ...way].forEach((factor, number) => take(frames.length + number, factor));
  const found = new Float32Array(4 * (planes + 1));
  for (let plane = 0; plane <= planes; plane++) {
    for (let k = 0; k < 3; k++) {
      const value = sums[3 * plane + k];
      found[4 * plane + k] += plane ? value * step[plane - 1] : value;
      if (plane) found[k] += value * low[plane - 1];
    }
  }
  return found;
}
