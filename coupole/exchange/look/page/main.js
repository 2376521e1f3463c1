// The page begins, and is given to scripts.

/** What scripts may use; docs/reference/page.md. */
function interfaceOf(app) {
  const drawn = () => app.settle(1);
  return {
    setLight(x, y, z) {
      if (![x, y, z].every(Number.isFinite) || length([x, y, z]) < 1e-9) {
        throw new RangeError("setLight: expected x, y, z, not all 0");
      }
      app.moving.stop();
      app.chosenLight.direction = unit([x, y, z]);
      app.changed("light");
    },
    readPixel(px, py) {
      const { width, height } = app.canvas;
      if (!Number.isInteger(px) || !Number.isInteger(py) || px < 0 || py < 0 || px >= width || py >= height) {
        throw new RangeError(`readPixel: expected whole numbers in ${width} x ${height}`);
      }
      drawn();
      return [...app.renderer.read(px, py, 1, 1).subarray(0, 3)];
    },
    readPicture() {
      drawn();
      const { width, height } = app.canvas;
      return { width, height, rgba: app.renderer.read(0, 0, width, height) };
    },
    whole: () => app.whole(),
    setSamples(most) {
      app.moving.stop();
      app.most = Math.max(1, Math.floor(most));
      app.changed("light");
      app.settle(app.most);
    },
    get state() {
      return structuredClone(app.state);
    },
    set state(given) {
      const found = stateOf(addressOf({ ...app.state, ...given }));
      if (!found) throw new RangeError("state: expected what this page gives");
      app.goTo(found);
    },
  };
}

/** The page with its coarse mesh, which stands at its beginning; null of pages that have none. */
async function begun() {
  if (!ABOUT.first.length) return null;
  const arrays = await readBlocks(ABOUT.first);
  const app = new App(ABOUT, Object.fromEntries(ABOUT.blocks.map((name) => [name, arrays[`first-${name}`]])));
  app.say("A coarse picture; the rest is being read…");
  await shown();
  await shown();
  return app;
}

async function begin() {
  let app = await begun();
  if (ABOUT.blocks.some((name) => !(name in coupoleBlocks))) await allRead;
  const arrays = await readBlocks(ABOUT.blocks);
  if (app) app.refine(arrays);
  else app = new App(ABOUT, arrays);
  await app.whole();
  if (app.about.picture_px && app.isNew) app.fitWhite();
  Object.defineProperties(window.coupole, Object.getOwnPropertyDescriptors(interfaceOf(app)));
  if (!app.lost.size) byId("status").textContent = "";
}

const ready = begin();
window.coupole = { ready };
ready.catch((error) => {
  byId("status").textContent = error.message;
});
