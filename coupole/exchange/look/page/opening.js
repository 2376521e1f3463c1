// The light that moves until somebody touches the page, and the detail that is left out while something moves.

const ROUND_S = 24;  // of the light about the object
const LOWEST_DEG = 25;  // height of the light where it is lowest
const LONGEST_STEP_S = 0.1;
const TOUCHES = ["pointerdown", "wheel", "keydown", "input", "change"];

class MovingLight {
  constructor(app) {
    this.app = app;
    this.button = byId("moving");
    this.button.hidden = !["mesh", "pictures"].includes(app.about.kind);
    this.isMoving = false;
    this.button.addEventListener("click", () => this.isMoving ? this.stop() : this.start());
    for (const name of TOUCHES) {
      window.addEventListener(name, (event) => event.target !== this.button && this.stop(), { capture: true, passive: true });
    }
    this.isCalm = window.matchMedia("(prefers-reduced-motion: reduce)");
    this.isCalm.addEventListener("change", () => this.isCalm.matches && this.stop());
  }

  /** At the beginning of a page that shows nothing in particular. */
  begin() {
    if (!this.isCalm.matches && !this.button.hidden) this.start();
  }

  start() {
    this.isMoving = true;
    [this.azimuth, this.height] = anglesOf(this.app.chosenLight.direction);
    this.height = Math.max(this.height, LOWEST_DEG);
    this.turned = 0;
    this.before_ms = performance.now();
    this.button.setAttribute("aria-pressed", "true");
    this.app.leaveFrame();
    this.app.changed("light");
  }

  /** The light stays where it is. */
  stop() {
    if (!this.isMoving) return;
    this.isMoving = false;
    this.button.setAttribute("aria-pressed", "false");
    this.app.changed("light");
  }

  /** Go on: round by azimuth, down to `LOWEST_DEG` on the other side and up again. */
  step() {
    const now_ms = performance.now(), seconds = Math.min((now_ms - this.before_ms) / 1000, LONGEST_STEP_S);
    this.before_ms = now_ms;
    this.turned = (this.turned + seconds / ROUND_S) % 1;
    const low = (1 - Math.cos(2 * Math.PI * this.turned)) / 2;
    const height = this.height + (LOWEST_DEG - this.height) * low;
    this.app.chosenLight.direction = wayOf(this.azimuth + 360 * this.turned, height);
  }
}

const MOTION_MS = 250;  // after the last change, something is said to move,
const MOTION_FRAMES = 16;  // or after the last picture of so many, as a browser that draws tells late of a change
const SLOW_MS = 67;  // of a picture: 15 in a second
const LEAST_DETAIL = 0.25;
const HOPELESS_MS = 200;  // of a picture in the least detail
const MOST_HOPELESS = 8;  // of such pictures, one after the other, before a light stops that a browser cannot move

/** How fine the picture is while something moves: coarser where it would be slow. */
class Detail {
  constructor() {
    this.share = 1;
    this.isCoarse = false;  // whether a coarse mesh is shown, if there is one
    this.until = 0;
    this.frames = 0;  // since the last change
    this.slow = this.hopeless = 0;
    this.took_ms = 0;
  }

  moved() {
    this.until = performance.now() + MOTION_MS;
    this.frames = 0;
  }

  get isInMotion() {
    return this.frames <= 1 || performance.now() < this.until;
  }

  /** A picture in motion took a time; whether the next one is to be of less detail. */
  isTooFine(took_ms) {
    this.took_ms = took_ms;
    if (this.frames <= MOTION_FRAMES) this.until = performance.now() + MOTION_MS + took_ms;
    this.slow = took_ms > SLOW_MS ? this.slow + 1 : 0;
    this.hopeless = took_ms > HOPELESS_MS && this.share <= LEAST_DETAIL ? this.hopeless + 1 : 0;
    if (this.isCoarse || this.slow < (took_ms > HOPELESS_MS ? 1 : 2)) return false;
    this.isCoarse = this.share <= LEAST_DETAIL;
    this.share = took_ms > HOPELESS_MS ? LEAST_DETAIL : Math.max(this.share / 2, LEAST_DETAIL);
    this.slow = 0;
    return true;
  }

  get isHopeless() {
    return this.hopeless >= MOST_HOPELESS;
  }

  /** All of it; whether it was less. */
  restore() {
    const was = this.share;
    [this.share, this.isCoarse, this.slow] = [1, false, 0];
    return was < 1;
  }
}
