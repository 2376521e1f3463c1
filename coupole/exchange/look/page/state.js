// What a user has set: all of it goes into the address, and back.

const MOST_LIGHTS = 10;
const MODES_OF_RUNS = { measured: "Nearest frame", between: "Between LEDs" };
const MODES_OF_SCENES = {
  relit: "Lit", diffuse: "Without highlights", specular: "Highlights only", normals: "Normals", roughness: "Roughness",
};
const MODES_OF_RESULTS = {
  relit: "Relit", diffuse: "Diffuse only", specular: "Highlights only", unsharp: "Relief enhanced",
  normals: "Normals", roughness: "Roughness", uncertainty: "Uncertainty", residual: "Residual of the fit",
};
if (ABOUT.texels) delete MODES_OF_RESULTS.residual;  // it is of triangles
const MODES = { run: MODES_OF_RUNS, scene: MODES_OF_SCENES }[ABOUT.kind] ?? MODES_OF_RESULTS;
const UNCERTAIN = {
  kd: "Diffuse colour", ks: "Highlight strength", normal: "Normal", roughness: "Roughness",
};

const startLight = () => ({
  direction: unit([-0.45, -0.15, 0.85]), strength: 1, colour: "#ffffff", kelvin: 6500, illuminant: "", softness: 1,
});

const startState = () => ({
  mode: Object.keys(MODES)[0], quantity: "kd", white: 0, relief: 1, sky: 0, environment: ABOUT.environment ? 1 : 0, chosen: 0, lights: [startLight()],
  camera: null, notes: [], view: "", split: 0.5, adapted: false, stereo: false, withResidual: true, beside: "", besideLight: null, ...structuredClone(ABOUT.start ?? {}),
});

const rounded = (key, value) => typeof value === "number" ? Number(value.toPrecision(5)) : value;

/** The part of an address after #. */
function addressOf(state) {
  const bytes = new TextEncoder().encode(JSON.stringify(state, rounded));
  return btoa(String.fromCharCode(...bytes)).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
}

const isNumber = (value, low, high) => Number.isFinite(value) && value >= low && value <= high;
const isVector = (value) => Array.isArray(value) && value.length === 3 && value.every(Number.isFinite);

function isLight(light) {
  return isVector(light?.direction) && length(light.direction) > 1e-6 && isNumber(light.strength, 0, 100)
    && /^#[0-9a-f]{6}$/.test(light.colour) && isNumber(light.kelvin, 1000, 20000)
    && isNumber(light.softness, 0, 30) && Object.hasOwn(ILLUMINANTS, light.illuminant ?? "");
}

function isCamera(camera) {
  return camera === null || isVector(camera?.target) && isNumber(camera.azimuth, -1e6, 1e6)
    && isNumber(camera.height, -90, 90) && isNumber(camera.distance, 1e-6, 1e6)
    && (camera.field === undefined || isNumber(camera.field, 0.01, 120));
}

function isNote(note) {
  return typeof note?.text === "string"
    && ["id", "created", "by"].every((name) => ["string", "undefined"].includes(typeof note[name]))
    && isVector(note.place) && isCamera(note.camera)
    && Array.isArray(note.lights) && note.lights.length > 0 && note.lights.length <= MOST_LIGHTS
    && note.lights.every(isLight);
}

/** Whether a state compares with something that this page has. */
function isComparison({ beside = "", besideLight = null }) {
  if (beside !== "light") return beside === "" || beside === "state" && Boolean(ABOUT.beside);
  return Array.isArray(besideLight?.lights) && isNumber(besideLight.lights.length, 1, MOST_LIGHTS)
    && besideLight.lights.every(isLight) && isNumber(besideLight.sky, 0, 100) && isNumber(besideLight.environment, 0, 100);
}

/** The state of an address; null if it holds none, or one that does not fit this page. */
function stateOf(address) {
  let found;
  try {
    const letters = atob(address.replaceAll("-", "+").replaceAll("_", "/"));
    found = JSON.parse(new TextDecoder().decode(Uint8Array.from(letters, (letter) => letter.charCodeAt(0))));
  } catch {
    return null;
  }
  const fits = Object.hasOwn(MODES, found?.mode) && Object.hasOwn(UNCERTAIN, found.quantity)
    && isNumber(found.white, 0, 1e9)
    && isNumber(found.relief, 0, 10) && isNumber(found.sky, 0, 100) && isCamera(found.camera)
    && (found.environment === undefined || isNumber(found.environment, 0, 100))
    && Array.isArray(found.lights) && isNumber(found.lights.length, 1, MOST_LIGHTS) && found.lights.every(isLight)
    && isNumber(found.chosen, 0, found.lights.length - 1) && Number.isInteger(found.chosen)
    && Array.isArray(found.notes) && found.notes.every(isNote)
    && (found.skyIlluminant === undefined || found.skyIlluminant in ILLUMINANTS)
    && (found.stereo === undefined || typeof found.stereo === "boolean")
    && (found.withResidual === undefined || typeof found.withResidual === "boolean")
    && (found.adapted === undefined || typeof found.adapted === "boolean")
    && isComparison(found)
    && (!found.view || viewOf(ABOUT, found.view)) && (found.split === undefined || isNumber(found.split, 0, 1));
  return fits ? { ...startState(), ...found } : null;
}
