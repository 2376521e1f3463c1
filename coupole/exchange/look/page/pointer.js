// Mouse, fingers and keys in the picture and on the sphere of lights.

const CLICK_PX = 5;
const KEY_PX = 14;
const TURN_DEG_PER_PX = 0.3;

class Pointer {
  constructor(app, canvas, sphere) {
    this.app = app;
    this.canvas = canvas;
    this.fingers = new Map();
    this.travelled = 0;
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => this.up(event));
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      app.zoom(Math.exp(0.0012 * event.deltaY));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => this.key(event));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    sphere.addEventListener("pointerdown", (event) => {
      sphere.setPointerCapture(event.pointerId);
      this.onSphere(sphere, event);
    });
    sphere.addEventListener("pointermove", (event) => event.buttons && this.onSphere(sphere, event));
    sphere.addEventListener("keydown", (event) => this.sphereKey(event));
  }

  down(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.canvas.focus({ focusVisible: false });
    if (!this.fingers.size) {
      this.travelled = 0;
      this.divides = this.app.controls.beside.isOnHandle(event.offsetX, event.offsetY);
    }
    this.fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
  }

  move(event) {
    const before = this.fingers.get(event.pointerId);
    if (!before) {
      this.canvas.classList.toggle("divides", this.app.controls.beside.isOnHandle(event.offsetX, event.offsetY));
      return;
    }
    const now = [event.offsetX, event.offsetY], x = now[0] - before[0], y = now[1] - before[1];
    this.travelled += Math.abs(x) + Math.abs(y);
    if (this.fingers.size === 1) {
      this.drag(event, x, y);
    } else {
      const other = [...this.fingers].find(([finger]) => finger !== event.pointerId)[1];
      const apart = (place) => Math.hypot(place[0] - other[0], place[1] - other[1]) || 1;
      this.app.zoom(apart(before) / apart(now));
      this.app.move(x / 2, y / 2);
    }
    this.fingers.set(event.pointerId, now);
  }

  drag(event, x, y) {
    const { app } = this;
    if (this.divides) app.controls.beside.divide(app.state.split + x / this.canvas.clientWidth);
    else if (event.buttons & 2 || event.altKey) app.move(x, y);
    else if (app.tool === "light" || event.shiftKey) app.dragLight(x, y);
    else app.turn(x, y);
  }

  up(event) {
    const was = this.fingers.delete(event.pointerId);
    if (was && !this.fingers.size && this.travelled < CLICK_PX && event.type === "pointerup") {
      this.app.click(event.offsetX, event.offsetY);
    }
  }

  key(event) {
    const { app } = this, way = arrowOf(event.key);
    const middle = [this.canvas.clientWidth / 2, this.canvas.clientHeight / 2];
    if (event.ctrlKey || event.metaKey) return;
    if (way && event.shiftKey) app.dragLight(way[0] * 12, way[1] * 12);
    else if (way && event.altKey) app.move(way[0] * 20, way[1] * 20);
    else if (way) app.turn(way[0] * KEY_PX, way[1] * KEY_PX);
    else if (event.key === "+" || event.key === "=") app.zoom(0.9);
    else if (event.key === "-") app.zoom(1 / 0.9);
    else if (event.key === "0") app.showAll();
    else if (event.key === "Enter") app.tell(...middle);
    else if (event.key.toLowerCase() === "m") app.measure(...middle);
    else if (event.key.toLowerCase() === "n") app.pin(...middle);
    else return;
    event.preventDefault();
  }

  onSphere(sphere, event) {
    const radius = sphere.clientWidth / 2 * (1 - 2 * DOT_PX / sphere.width), middle = sphere.clientWidth / 2;
    this.app.aim((event.offsetX - middle) / radius, (middle - event.offsetY) / radius);
  }

  sphereKey(event) {
    const way = arrowOf(event.key);
    if (!way) return;
    event.preventDefault();
    this.app.dragLight(way[0] * 12, way[1] * 12);
  }
}

/** Right and down of an arrow key. */
function arrowOf(key) {
  return { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[key];
}
