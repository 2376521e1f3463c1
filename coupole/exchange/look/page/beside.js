// Two pictures in one, divided by a line: of two lights, or of two states of the object.

const BESIDE_TURN_DEG = 180;  // between the two lights, at first
const HANDLE_PX = 22;

/** What may be compared with on a page. */
function besideChoices(about) {
  if (!["mesh", "pictures"].includes(about.kind)) return {};
  return { "": "nothing", light: "another light", ...about.beside && { state: about.beside.name } };
}

/** Whether a state shows two pictures; `other` is the other state of the object, if it is at hand. */
function isBeside(state, other) {
  return !state.view && (state.beside === "light" ? Boolean(state.besideLight) : state.beside === "state" && Boolean(other));
}

/** The state that the left picture shows. */
function leftOf(state) {
  return state.beside === "light" ? { ...state, ...state.besideLight, chosen: 0 } : state;
}

const lightOf = ({ lights, sky, environment }) => structuredClone({ lights, sky, environment });

/** Whether a line divides the picture. */
function isDivided(state) {
  return Boolean(state.beside) || Boolean(state.view && ABOUT.kind === "mesh" && isLit(state.mode));
}

class Beside {
  constructor(app) {
    this.app = app;
    const found = besideChoices(app.about);
    byId("beside-section").hidden = !Object.keys(found).length;
    byId("beside-section").open = Boolean(app.about.beside);
    byId("beside").append(...choices(found));
    byId("beside").addEventListener("change", () => this.choose(byId("beside").value));
    byId("beside-split").addEventListener("input", () => this.divide(byId("beside-split").valueAsNumber));
    byId("beside-swap").addEventListener("click", () => this.swap());
  }

  choose(what) {
    const { state } = this.app;
    this.app.leaveFrame();
    state.beside = what;
    state.besideLight = what === "light" ? lightOf(state) : null;
    if (what === "light") {
      const [azimuth, height] = anglesOf(this.app.chosenLight.direction);
      this.app.chosenLight.direction = wayOf(azimuth + BESIDE_TURN_DEG, height);
    }
    this.app.changed("light");
  }

  divide(share) {
    this.app.state.split = clamp(share, 0, 1);
    this.app.changed("light");
  }

  /** The left light becomes the one that the settings are for. */
  swap() {
    const { state } = this.app, kept = lightOf(state);
    Object.assign(state, state.besideLight, { besideLight: kept, chosen: 0 });
    this.app.changed("light");
  }

  /** Whether a pointer is on the line's handle, px of the page. */
  isOnHandle(x, y) {
    const { state, canvas: { clientWidth: width, clientHeight: height } } = this.app;
    return isDivided(state) && Math.hypot(x - state.split * width, y - height / 2) < HANDLE_PX;
  }

  show() {
    const { state, about } = this.app;
    byId("beside").value = state.beside;
    byId("beside-split-row").hidden = !state.beside;
    byId("beside-split").value = state.split;
    byId("beside-swap").hidden = state.beside !== "light";
    byId("beside-told").textContent = {
      light: "Left of the line is the light before the change; right of it is the light of the settings.",
      state: about.beside && `Left of the line: ${about.beside.name}. Right of it: ${about.title}. ${about.beside.told}`,
    }[state.beside] ?? "Drag the line in the picture, or use Divide.";
  }
}

/** Names of both sides. */
function sidesOf(state) {
  if (state.beside === "state") return [ABOUT.beside.name, ABOUT.title];
  return state.beside === "light" ? ["light as it was", "light of the settings"] : ["frame", "fit"];
}

/** The line between two pictures with its handle and the names of both, as markup. */
function splitOf(state, width, height) {
  if (!isDivided(state)) return "";
  const x = state.split * width, middle = height / 2, [left, right] = sidesOf(state).map(escaped);
  return `<line class="split" x1="${x}" x2="${x}" y1="0" y2="${height}"/>
    <circle class="handle" cx="${x}" cy="${middle}" r="14"/>
    <path class="arrows" d="M${x - 4} ${middle - 5}l-5 5l5 5M${x + 4} ${middle - 5}l5 5l-5 5"/>
    <text class="side" text-anchor="end" x="${x - 24}" y="${middle + 5}">${left}</text>
    <text class="side" x="${x + 24}" y="${middle + 5}">${right}</text>`;
}
