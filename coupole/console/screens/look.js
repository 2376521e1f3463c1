/* On a picture of the camera: a drag draws a region, a click picks a point; both are told in the sensor's pixels. */
(() => {
  const DRAGGED_PX = 5;
  let drawn = null;

  function at(look, event) {
    const box = look.getBoundingClientRect();
    const [width, height] = [Number(look.dataset.width), Number(look.dataset.height)];
    const share = (value, low, size) => Math.min(1, Math.max(0, (value - low) / size));
    return [share(event.clientX, box.left, box.width) * width, share(event.clientY, box.top, box.height) * height];
  }

  function rectangle(a, b) {
    const [x, y] = [Math.min(a[0], b[0]), Math.min(a[1], b[1])].map(Math.floor);
    return [x, y, Math.floor(Math.max(a[0], b[0])) - x, Math.floor(Math.max(a[1], b[1])) - y];
  }

  document.addEventListener("pointerdown", event => {
    const look = event.target instanceof Element ? event.target.closest(".look") : null;
    if (!look || event.button !== 0 || !look.dataset.width) return;
    event.preventDefault();
    drawn = {look, from: at(look, event), x: event.clientX, y: event.clientY};
  });
  document.addEventListener("pointermove", event => {
    const band = drawn?.look.querySelector(".band");
    if (!band) return;
    const [x, y, width, height] = rectangle(drawn.from, at(drawn.look, event));
    for (const [name, value] of Object.entries({x, y, width, height})) band.setAttribute(name, value);
  });
  document.addEventListener("pointercancel", () => { drawn = null; });
  document.addEventListener("pointerup", event => {
    if (!drawn) return;
    const {look, from, x, y} = drawn;
    drawn = null;
    const to = at(look, event);
    const moved = Math.max(Math.abs(event.clientX - x), Math.abs(event.clientY - y)) > DRAGGED_PX;
    look.querySelector(".band")?.setAttribute("width", 0);
    const detail = moved ? {region: rectangle(from, to)} : {point: to.map(Math.floor)};
    look.dispatchEvent(new CustomEvent("picked", {detail}));
  });
})();
