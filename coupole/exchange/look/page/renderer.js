// The picture: samples of lights and of a pixel's places, one after the other, and their mean.

const SAMPLES = 64;
const SHADOW_PX = [512, 2048];  // least and most
const MODE_NUMBERS = {
  relit: 0, diffuse: 1, specular: 2, unsharp: 3, normals: 4, roughness: 5, uncertainty: 6, residual: 7,
};
const ARRAYS = ["shadows", "planes", "residual", "residual_planes", "texel_colours"];
const RAMP = ["#2a2140", "#3b4f8f", "#2f8f8c", "#8fbf5a", "#f0c24b", "#fff4cf"];
const TEXTURES = {
  places: ["uint16", 3], triangles: ["uint32", 3], normals: ["uint16", 2], kd: ["float16", 3], ks: ["float16", 3],
  gloss: ["float16", 2], uncertainty: ["uint8", 4],
};
const TEXTURES_OF_TEXELS = { ...TEXTURES, map_places: ["uint32", 3] };

/** How numbers of a mode are shown: by a ramp from and to, in steps or in ratios. */
function rangeOf(mode, quantity) {
  if (mode === "roughness") return { from: 0, to: 1, logarithmic: false, unit: "GGX alpha" };
  if (mode === "residual") return { from: 0, to: 0.3, logarithmic: false, unit: "share of the square root of kd" };
  if (quantity === "normal") return { from: radians(0.01), to: radians(10), logarithmic: true, unit: "degrees" };
  return { from: 0.003, to: 3, logarithmic: true, unit: "%" };
}

const IDENTITY = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];

const EYES_DEG = 3.4;  // between two eyes, 65 mm apart, that look at a thing 1.1 m away

const OUTLINE_PLACES = 3000;

const isStereo = (state) => Boolean(state.stereo && !state.view && !state.beside && ["mesh", "scene"].includes(ABOUT.kind));

class Renderer {
  constructor(canvas, about, arrays) {
    this.gl = canvas.getContext("webgl2", { antialias: false, preserveDrawingBuffer: true });
    if (!this.gl) throw new Error("This browser has no WebGL 2, which the picture needs.");
    this.canvas = canvas;
    this.about = about;
    this.samples = 0;
    this.targets = null;
    this.depths = null;
    this.coarse = null;
    this.isCoarse = false;
    this.arrived = () => {};  // what is called when more has come
    this.measure();
    this.bodies = [{ about, texels: new Texels(this.gl, about) }];
    this.shadowMaps = {};
    this.prepare(arrays);
    this.residual = new Residual(this.gl, about, this.middle);
    this.frames = {};
  }

  /** The measured frame that a state compares with, if it is at hand. */
  frameOf(state) {
    const view = viewOf(this.about, state.view);
    if (!view) return null;
    const frame = nearestFrame(view, this.middle, state.lights[state.chosen].direction);
    return { view, frame, texture: this.frames[frame.block] };
  }

  /** The direction of the LED, of those whose frames the page has, that is nearest to one. */
  nearestLed(way) {
    const ways = this.about.views.flatMap(({ frames }) => frames.map(({ at_mm: place }) => unit(minus(place, this.middle))));
    return ways.reduce((best, one) => dot(one, way) > dot(best, way) ? one : best);
  }

  /** What is shown as white, and its unit: a frame that is compared with has its own. */
  whiteOf(state) {
    const compared = this.frameOf(state);
    return compared ? [compared.frame.peak, "of the camera's range"] : [state.white || 1, this.about.unit];
  }

  banner(state) {
    return bannerOf(this.about, state, this.frameOf(state), this.residual.told(state));
  }

  /** The material of what `seenAt` has found, of the object or of its other state. */
  materialOf(number, body = 0) {
    return materialOf(this.bodies[body].arrays, number);
  }

  /** Places of the object, some thousand of them, between which it lies. */
  get outline() {
    const { arrays: { places }, about: { origin_mm: origin, step_mm: step } } = this, found = [];
    const every = 3 * Math.max(1, Math.ceil(places.length / 3 / OUTLINE_PLACES));
    for (let k = 0; k < places.length; k += every) found.push(add(origin, times([...places.subarray(k, k + 3)], step)));
    return found;
  }

  /** The object's other state, if it is to be shown and is not at hand yet; else null. */
  missingBeside(state) {
    return state.beside === "state" && !this.bodies[1] ? this.about.beside : null;
  }

  async bringBeside() {
    const { beside } = this.about, arrays = {};
    for (const name of beside.blocks) arrays[name] = await laterBlock(this.about, `beside-${name}`);
    this.bodies[1] = { about: { ...this.about, ...beside }, texels: new Texels(this.gl, { ...this.about, ...beside }) };
    this.fill(this.bodies[1], arrays);
  }

  /** Whether there is anything to be seen. */
  get hasPicture() {
    return true;
  }

  /** Whether something has yet to come for the picture to be whole. */
  get isWaiting() {
    return false;
  }

  /** Whether colours are shown to an eye that is used to the chosen light; never those of measured frames. */
  isAdapted(state) {
    return state.adapted && isLit(state.mode) && !this.frameOf(state);
  }

  /** The view whose residual belongs to the picture and is not at hand yet; null for none. */
  missingResidual(state) {
    const view = this.triangles === this.about.triangles ? this.residual.wantedFor(state)?.view : null;
    return view && !this.residual.texturesOf(view) ? view : null;
  }

  /** The tile of texels that is wanted next; null for none, and while a coarse mesh is shown. */
  get missingTexels() {
    if (this.triangles !== this.about.triangles) return null;
    return this.bodies.map(({ texels }) => texels.wanted).find(Boolean) ?? null;
  }

  keepFrame(frame, bytes) {
    this.frames[frame.block] = bytesTexture(this.gl, bytes, ...frame.size_px);
  }

  /** The box and the sphere that hold the object. */
  measure() {
    const { origin_mm: origin, step_mm: step, box: ends } = this.about, [low, high] = ends;
    this.corners = [0, 1, 2, 3, 4, 5, 6, 7].map((number) => add(
      origin, times([0, 1, 2].map((k) => ends[number >> k & 1][k]), step),
    ));
    this.middle = add(origin, times(add(low, high), step / 2));
    this.radius = Math.max(length(minus(high, low)) * step / 2, 1e-6);
  }

  prepare(arrays) {
    const gl = this.gl;
    this.programs = {
      surface: programOf(gl, this.surfaceShader, "surface.frag"),
      shadow: programOf(gl, "surface.vert", "shadow.frag"),
      light: programOf(gl, "screen.vert", this.lightShader),
      show: programOf(gl, "screen.vert", "show.frag"),
    };
    this.textures = {};
    this.take(arrays);
    gl.bindVertexArray(gl.createVertexArray());
    gl.enable(gl.DEPTH_TEST);
  }

  /** Of a sphere that holds what casts shadows. */
  get castingRadius() {
    return this.radius;
  }

  get surfaceShader() {
    return "surface.vert";
  }

  get lightShader() {
    return "light.frag";
  }

  /** Type and count of the numbers of each texture. */
  fieldsOf(about) {
    return about.texels ? TEXTURES_OF_TEXELS : TEXTURES;
  }

  /** Show these numbers of the object from now on. */
  take(arrays) {
    this.fill(this.bodies[0], arrays);
    this.hold(0);
    this.restart();
  }

  /** Show all of a mesh from now on. What was taken before, a coarse one, stands in its place while `isCoarse`. */
  refine(arrays) {
    this.coarse = this.bodies[0];
    this.bodies[0] = { about: this.about, texels: this.coarse.texels };
    this.take(arrays);
  }

  /** Give a state of the object its numbers. */
  fill(body, arrays) {
    Object.assign(body, { arrays, triangles: arrays.triangles.length / 3, textures: body.textures ?? {} });
    for (const [name, [dtype, count]] of Object.entries(this.fieldsOf(body.about))) {
      this.gl.deleteTexture(body.textures[name] ?? null);
      body.textures[name] = numbersTexture(this.gl, arrays[name], dtype, count);
    }
    Object.values(this.shadowMaps).forEach((maps) => { maps.drawn = []; });
  }

  /** Draw the object, 0, or its other state, 1, until another is held. */
  hold(number) {
    const body = number === 0 && this.isCoarse && this.coarse || this.bodies[number];
    const { arrays, triangles, textures, texels } = body;
    Object.assign(this, { held: number, arrays, triangles, textures, texels });
  }

  use(name, textures) {
    const gl = this.gl, program = this.programs[name];
    gl.useProgram(program.program);
    Object.entries(textures).forEach(([uniform, texture], number) => {
      gl.activeTexture(gl.TEXTURE0 + number);
      gl.bindTexture(ARRAYS.includes(uniform) ? gl.TEXTURE_2D_ARRAY : gl.TEXTURE_2D, texture);
      gl.uniform1i(program.at(uniform), number);
    });
    gl.uniform3fv(program.at("origin_mm"), this.about.origin_mm);
    gl.uniform1f(program.at("step_mm"), this.about.step_mm);
    return program.at;
  }

  /** Make room for a picture of the canvas's size. */
  fit() {
    const { width, height } = this.canvas;
    if (this.targets && this.width === width && this.height === height) return;
    if (this.targets) Object.values(this.targets).forEach((target) => target.free());
    [this.width, this.height] = [width, height];
    this.targets = {
      seen: pictureTarget(this.gl, width, height, true),
      mean: pictureTarget(this.gl, width, height, false),
      other: pictureTarget(this.gl, width, height, false),
    };
    this.samples = 0;
  }

  /** Forget the samples: something has changed. */
  restart() {
    this.samples = 0;
  }

  /** Draw one more sample into the mean. */
  sample(state) {
    this.fit();
    this.shownParts = this.parts(state);
    for (const part of this.shownParts) {
      this.hold(part.body);
      this.shownResidual = part.body ? null : this.residual.wantedFor(part.state);
      const beams = this.beamsOf(part.state);
      this.drawShadows(beams, part.maps);
      this.gl.enable(this.gl.SCISSOR_TEST);
      this.gl.scissor(part.from, 0, part.to - part.from, this.height);
      this.drawSurface(part.state, part);
      this.drawLight(part.state, beams);
      this.gl.disable(this.gl.SCISSOR_TEST);
    }
    this.hold(0);
    [this.targets.mean, this.targets.other] = [this.targets.other, this.targets.mean];
    this.samples += 1;
  }

  /** Parts of the picture from one pixel to another, from the left, each with its viewport, its state, the object or
   * its other state, and its shadow maps: all of it, both sides of a comparison, or one for each eye, the left
   * eye's to the left. */
  parts(state) {
    const whole = { x: 0, width: this.width, from: 0, to: this.width, state, body: 0, maps: 0 };
    if (isBeside(state, this.bodies[1])) {
      const split = Math.round(state.split * this.width);
      const left = { ...whole, to: split, state: leftOf(state), body: state.beside === "state" ? 1 : 0, maps: 1 };
      return [left, { ...whole, from: split }].filter(({ from, to }) => to > from);
    }
    if (!isStereo(state)) return [whole];
    const width = Math.floor(this.width / 2);
    return [-1, 1].map((side, number) => ({
      ...whole, x: number * width, width, from: number * width, to: (number + 1) * width,
      state: { ...state, camera: turned(state.camera, side * EYES_DEG / 2, 0) },
    }));
  }

  /** Lights of this sample. */
  beamsOf(state) {
    const compared = this.frameOf(state);
    if (compared) return [this.ledBeam(compared.frame)];
    const beams = state.lights.map((light, number) => ({
      way: sampledDirection(light, this.samples, number), irradiance: irradiance(light, this.about.irradiance),
    }));
    if (state.sky > 0) {
      const { way, irradiance: sky } = sampledSky(state.sky * this.about.irradiance / Math.PI, this.samples);
      beams.push({ way, irradiance: sky });
    }
    const { environment } = this.about;
    if (environment && state.environment > 0) {
      const number = this.samples % environment.ways.length;
      const factor = state.environment * this.about.irradiance / Math.PI;
      beams.push({ way: environment.ways[number], irradiance: times(environment.irradiances[number], factor) });
    }
    return beams.map((beam) => ({ ...beam, place: null, shadow: this.shadowMatrix(beam.way) }));
  }

  ledBeam({ at_mm: place, strength }) {
    const apart = minus(place, this.middle), way = unit(apart), distance = length(apart);
    const [right, up] = across(way);
    const reach = this.radius * 1.01, near = Math.max(distance - reach, distance * 0.01);
    const half = reach / Math.sqrt(Math.max(distance ** 2 - reach ** 2, reach ** 2));
    const clip = perspective(half, half, near, distance + reach);
    return { way, irradiance: strength, place, shadow: product(clip, lookingFrom(place, right, up, way)) };
  }

  shadowMatrix(way) {
    const [right, up] = across(way), reach = this.radius * 1.01;
    const from = lookingFrom(add(this.middle, times(way, 2 * reach)), right, up, way);
    return product(orthographic(reach, reach, reach, 3 * reach), from);
  }

  drawShadows(beams, number) {
    const gl = this.gl, maps = this.shadowMaps[number] ??= { depths: null, drawn: [] };
    const wished = 2 ** Math.ceil(Math.log2(2 * Math.max(this.width, this.height)));
    const size = clamp(wished, ...SHADOW_PX);
    if (!maps.depths || maps.depths.layers < beams.length || maps.depths.size !== size) {
      maps.depths?.free();
      maps.depths = depthLayers(gl, size, beams.length);
      maps.drawn = [];
    }
    this.depths = maps.depths;
    const { places, triangles } = this.textures;
    const at = this.use("shadow", { places, triangles });
    gl.viewport(0, 0, size, size);
    beams.forEach((beam, layer) => {
      const drawn = `${this.held} ${this.triangles} ${beam.shadow}`;
      if (maps.drawn[layer] === drawn) return;
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.depths.frames[layer]);
      gl.clear(gl.DEPTH_BUFFER_BIT);
      gl.uniformMatrix4fv(at("clip_from_object"), false, beam.shadow);
      gl.drawArrays(gl.TRIANGLES, 0, 3 * this.triangles);
      maps.drawn[layer] = drawn;
    });
  }

  drawSurface({ camera }, { x: left, width }) {
    const gl = this.gl, [x, y] = evenly(this.samples);
    const at = this.useSurface(camera);
    const clip = clipOf(camera, width, this.height, this.middle, this.radius, [x - 0.5, y - 0.5]);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.targets.seen.frame);
    gl.viewport(left, 0, width, this.height);
    gl.clearBufferuiv(gl.COLOR, 0, [0, 0, 0, 0]);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(at("clip_from_object"), false, clip);
    gl.drawArrays(gl.TRIANGLES, 0, 3 * this.triangles);
  }

  useSurface() {
    const { places, triangles } = this.textures;
    return this.use("surface", { places, triangles });
  }

  drawLight(state, beams) {
    const gl = this.gl, { seen, mean } = this.targets;
    const compared = this.frameOf(state);
    const at = this.use("light", {
      ...this.textures, seen: seen.texture, before: mean.texture, shadows: this.depths.texture,
      measured: compared?.texture ?? this.textures.kd, ...this.residualTextures(), ...this.texelTextures(),
    });
    this.setResidual(at);
    this.setTexels(at);
    this.setLed(at, compared, state.split);
    gl.uniform1i(at("quantity"), Object.keys(UNCERTAIN).indexOf(state.quantity));
    gl.uniform1f(at("relief"), state.relief);
    gl.uniform1i(at("flat_one"), this.about.picture_px ? 1 : 0);
    gl.uniform3fv(at("irradiances"), beams.flatMap((beam) => beam.irradiance));
    this.drawMean(at, state, beams);
  }

  residualTextures() {
    const wanted = this.shownResidual, none = this.depths.texture;
    return wanted && this.residual.texturesOf(wanted.view) || { residual: none, residual_planes: none };
  }

  texelTextures() {
    const { map_places = this.textures.triangles } = this.textures;
    return { map_places, ...this.texels.textures ?? { texel_shape: this.textures.kd, texel_colours: this.depths.texture } };
  }

  setTexels(at) {
    this.gl.uniform1i(at("has_texels"), this.texels.textures ? 1 : 0);
    if (this.texels.textures) this.gl.uniform2fv(at("texel_peaks"), this.texels.about.texels.peaks);
  }

  setResidual(at) {
    const gl = this.gl, wanted = this.shownResidual;
    const isThere = wanted && this.residual.texturesOf(wanted.view);
    gl.uniform1i(at("residual_count"), isThere ? this.about.residual.planes : 0);
    if (!isThere) return;
    gl.uniform3fv(at("residual_mm"), wanted.view.camera_mm);
    gl.uniform2fv(at("residual_cosines"), RESIDUAL_DEG.map((angle) => Math.cos(radians(angle))));
  }

  /** Draw the mean with one sample more, by a program of light: what all of them have in common. */
  drawMean(at, state, beams) {
    const gl = this.gl, { right, up, back, place } = axesOf(state.camera);
    gl.uniform1i(at("mode"), MODE_NUMBERS[state.mode]);
    gl.uniform1f(at("share"), 1 / (this.samples + 1));
    gl.uniform3fv(at("eye_mm"), place);
    gl.uniformMatrix3fv(at("view_from_object"), false, [0, 1, 2].flatMap((k) => [right[k], up[k], back[k]]));
    gl.uniform1i(at("lights"), beams.length);
    gl.uniform3fv(at("ways"), beams.flatMap((beam) => beam.way));
    gl.uniformMatrix4fv(at("shadow_from_object"), false, beams.flatMap((beam) => [...beam.shadow]));
    const texel = 2 * this.castingRadius * 1.01 / this.depths.size;
    gl.uniform1fv(at("offset_mm"), beams.map(() => 1.5 * texel));
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.targets.other.frame);
    gl.viewport(0, 0, this.width, this.height);
    gl.disable(gl.DEPTH_TEST);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.enable(gl.DEPTH_TEST);
  }

  setLed(at, compared, split) {
    const gl = this.gl;
    gl.uniform1i(at("led"), compared ? 1 : 0);
    if (!compared) return;
    const { view, frame, texture } = compared;
    gl.uniform3fv(at("led_mm"), frame.at_mm);
    gl.uniform3fv(at("led_axis"), frame.axis);
    gl.uniform1f(at("led_exponent"), this.about.led_exponent);
    gl.uniform1f(at("measured_peak"), frame.peak);
    gl.uniform1f(at("split_px"), texture ? split * this.width : 0);
    gl.uniform3fv(at("view_mm"), view.camera_mm);
    gl.uniformMatrix3fv(at("view_from_way"), false, [0, 1, 2].flatMap((k) => view.axes.map((axis) => axis[k])));
    gl.uniform2fv(at("lens"), view.lens.flat());
  }

  /** Put the mean on the screen. */
  show(state, ground) {
    const gl = this.gl, { seen, mean } = this.targets;
    const at = this.use("show", { mean: mean.texture, seen: seen.texture });
    const { from, to, logarithmic } = rangeOf(state.mode, state.quantity);
    const number = ["roughness", "uncertainty", "residual"].includes(state.mode);
    gl.uniform1i(at("kind"), state.mode === "normals" ? 1 : number ? 2 : 0);
    gl.uniform1f(at("white"), this.whiteOf(state)[0]);
    const eye = this.isAdapted(state) ? adaptation(chromaticity(state.lights[state.chosen])) : IDENTITY;
    gl.uniformMatrix3fv(at("adapted"), false, eye.flat());
    gl.uniform2f(at("range"), from, to);
    gl.uniform1i(at("logarithmic"), logarithmic ? 1 : 0);
    gl.uniform3fv(at("ramp"), RAMP.flatMap((text) => channelsOf(text)));
    gl.uniform3fv(at("ground"), channelsOf(ground));
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, this.width, this.height);
    gl.disable(gl.DEPTH_TEST);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.enable(gl.DEPTH_TEST);
  }

  /** Four floats for each pixel of a part of the mean: red, green, blue, and 1 where there is a material. Row by
   * row from the top; x to the right, y down. */
  read(x, y, width, height) {
    return new Float32Array(this.readBits(this.targets.mean, x, y, width, height).buffer);
  }

  /** What a pixel sees: its place, mm, the number of a triangle, and whether it is the object, 0, or its other
   * state, 1; null for none. */
  seenAt(x, y) {
    if (x < 0 || y < 0 || x >= this.width || y >= this.height) return null;
    const found = this.readBits(this.targets.seen, x, y, 1, 1);
    if (!found[3]) return null;
    const { body } = this.shownParts.find(({ from, to }) => x >= from && x < to) ?? { body: 0 };
    return { place: [...new Float32Array(found.buffer, 0, 3)], triangle: found[3] - 1, body };
  }

  /** The unit normal of what `seenAt` has found, of its flat triangle. */
  faceOf({ triangle, body }) {
    const { arrays: { places, triangles }, about: { step_mm: step } } = this.bodies[body];
    const [a, b, c] = [0, 1, 2].map((k) => {
      const number = triangles[3 * triangle + k];
      return times([...places.subarray(3 * number, 3 * number + 3)], step);
    });
    return unit(cross(minus(b, a), minus(c, a)));
  }

  readBits(target, x, y, width, height) {
    const gl = this.gl, found = new Uint32Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.frame);
    gl.readPixels(x, this.height - y - height, width, height, gl.RGBA_INTEGER, gl.UNSIGNED_INT, found);
    const rows = new Uint32Array(found.length), row = 4 * width;
    for (let k = 0; k < height; k++) rows.set(found.subarray(k * row, (k + 1) * row), (height - 1 - k) * row);
    return rows;
  }

  /** 99.9 % quantile of the channels of pixels that are not dark. */
  brightest() {
    const picture = this.read(0, 0, this.width, this.height), found = [];
    for (let k = 0; k < picture.length; k += 4) {
      const rgb = picture.subarray(k, k + 3);
      if (Math.max(...rgb) > 0) found.push(...rgb);
    }
    const sorted = Float32Array.from(found).sort();
    return sorted.length ? sorted[Math.floor(0.999 * (sorted.length - 1))] : 1;
  }
}

/** Red, green, blue from 0 to 1 of a colour in hexadecimal digits. */
function channelsOf(text) {
  return [1, 3, 5].map((at) => parseInt(text.slice(at, at + 2), 16) / 255);
}
