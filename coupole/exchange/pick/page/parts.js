// Parts: their names and colours, which triangle is of which, strokes that can be undone, and the file.

const UNPAINTED = [150, 150, 148];
const MOST_PARTS = 254;
const NAME = /^[A-Za-z0-9][A-Za-z0-9 ._-]{0,63}$/;

class Parts {
  constructor(count) {
    this.names = [];
    this.of = new Uint8Array(count);
    this.strokes = [];
    this.stroke = null;
  }

  /** Colours that differ: steps of the golden angle in hue, two lightnesses. */
  get palette() {
    const turn = (k) => (k * 137.508) % 360;
    return [UNPAINTED, ...this.names.map((_, k) => rgbOf(turn(k), k % 2 ? 0.42 : 0.6))];
  }

  begin() {
    this.stroke = new Map();
  }

  paint(triangles, part) {
    for (const k of triangles) {
      if (this.of[k] === part) continue;
      if (!this.stroke.has(k)) this.stroke.set(k, this.of[k]);
      this.of[k] = part;
    }
  }

  end() {
    if (this.stroke?.size) this.strokes.push(this.stroke);
    this.stroke = null;
  }

  undo() {
    for (const [k, part] of this.strokes.pop() ?? []) this.of[k] = part;
  }

  /** What is wrong with the names of painted parts; empty if nothing is. */
  wrong() {
    const used = this.used();
    if (!used.length) return "Nothing is painted yet.";
    const names = used.map((k) => this.names[k - 1]), bad = names.find((name) => !NAME.test(name));
    if (bad !== undefined) return `The name “${bad}” is empty, or has a letter other than A-Z, a-z, 0-9, blank, ., _ and -.`;
    const twice = names.find((name, k) => names.indexOf(name) !== k);
    return twice === undefined ? "" : `Two parts are named “${twice}”.`;
  }

  /** Parts, counted from 1, that have triangles. */
  used() {
    return [...new Set(this.of)].filter((part) => part > 0).sort((a, b) => a - b);
  }

  /** The file's text; parts without triangles are left out. */
  file() {
    const used = this.used();
    return JSON.stringify({
      schema_version: 1, kind: "picked parts", names: used.map((part) => this.names[part - 1]),
      vertices_mm: MESH.vertices_mm, triangles: MESH.triangles,
      parts: base64Of(this.of.map((part) => used.indexOf(part) + 1)),
    });
  }

  /** Take what a file has. Throws if it is of another mesh, or no such file. */
  read(text) {
    const file = JSON.parse(text);
    if (file.kind !== "picked parts") throw new Error("this file was not saved by this page");
    if (file.vertices_mm !== MESH.vertices_mm || file.triangles !== MESH.triangles) {
      throw new Error("this file is of another mesh");
    }
    this.of.set(bytesOf(file.parts));
    this.names = [...file.names];
    this.strokes = [];
  }
}

function rgbOf(hue, lightness) {
  const reach = 0.75 * Math.min(lightness, 1 - lightness);
  const one = (n) => {
    const k = (n + hue / 30) % 12;
    return Math.round(255 * (lightness - reach * Math.max(-1, Math.min(k - 3, 9 - k, 1))));
  };
  return [one(0), one(8), one(4)];
}
