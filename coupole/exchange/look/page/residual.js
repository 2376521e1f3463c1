// What GGX leaves of each triangle: numbers of a few planes, of the view that it was fitted to.

const RESIDUAL_DEG = [10, 30];  // between the eye and the view's camera: all of it up to here, none from there
const NEAR_ENOUGH_DEG = 45;  // at the object's middle: beyond it a view's residual is not asked for
const VIEWS_HELD = 4;

class Residual {
  constructor(gl, about, middle) {
    Object.assign(this, { gl, about, middle, held: new Map() });
  }

  /** The view whose residual belongs to a picture, and degrees from the eye to its camera; null for none. */
  wantedFor(state) {
    const { residual } = this.about;
    if (!residual || state.mode !== "relit" || !state.withResidual) return null;
    const toEye = unit(minus(axesOf(state.camera).place, this.middle));
    const found = residual.views.map((view) => ({
      view, away_deg: degrees(Math.acos(clamp(dot(toEye, unit(minus(view.camera_mm, this.middle))), -1, 1))),
    })).reduce((best, one) => one.away_deg < best.away_deg ? one : best);
    return found.away_deg < NEAR_ENOUGH_DEG ? found : null;
  }

  /** Its textures; undefined until they have come. */
  texturesOf(view) {
    return this.held.get(view.name);
  }

  async bring(view) {
    const [codes, planes] = await Promise.all(view.blocks.map((name) => laterBlock(this.about, name)));
    const { planes: count, side } = this.about.residual;
    if (this.held.size === VIEWS_HELD) this.drop(this.held.keys().next().value);
    this.held.set(view.name, {
      residual: fours(this.gl, codes, 3 + count), residual_planes: tablesTexture(this.gl, planes, side, count),
    });
  }

  drop(name) {
    Object.values(this.held.get(name)).forEach((texture) => this.gl.deleteTexture(texture));
    this.held.delete(name);
  }

  /** What is said of it in the picture. */
  told(state) {
    const wanted = this.wantedFor(state);
    if (!wanted || !this.texturesOf(wanted.view)) return this.about.residual && state.mode === "relit" ? ["GGX alone"] : [];
    const { view, away_deg: away } = wanted;
    const share = `${Number((100 * this.about.residual.kept).toPrecision(4))} %`;
    if (away < 0.5) return [`with ${share} of its residual`];
    if (away < RESIDUAL_DEG[1]) return [`with its residual of the view ${view.name}, ${away.toFixed(0)}° from here`];
    return [`GGX alone: the view ${view.name} is ${away.toFixed(0)}° away`];
  }
}

/** A texture of bytes [count, n] by numbers of n, four fields to a layer. */
function fours(gl, codes, count) {
  const size = codes.length / count, rows = Math.max(1, Math.ceil(size / ROW)), layers = Math.ceil(count / 4);
  const texture = layersTexture(gl, layers, rows);
  for (let layer = 0; layer < layers; layer++) {
    const bytes = new Uint8Array(4 * rows * ROW);
    for (let field = 4 * layer; field < Math.min(4 * layer + 4, count); field++) {
      for (let k = 0; k < size; k++) bytes[4 * k + field % 4] = codes[field * size + k];
    }
    putLayer(gl, texture, layer, 0, bytes);
  }
  return texture;
}
