// Measured frames, laid on the object, beside the prediction of the fit for the same LED.

/** A block that may still lie beside the page; its script is asked for by a tag. */
async function laterBlock(about, name) {
  if (!(name in coupoleBlocks)) await allRead;
  const isBeside = !(name in coupoleBlocks);
  if (isBeside) {
    await new Promise((resolve, reject) => {
      const src = `${encodeURIComponent(about.data)}/${encodeURIComponent(name)}.js`;
      const script = Object.assign(document.createElement("script"), { src });
      script.onload = resolve;
      script.onerror = () => reject(new Error(`${name} is missing: keep the page's .data folder beside it.`));
      document.head.append(script);
    });
  }
  const block = coupoleBlocks[name];
  if (isBeside) delete coupoleBlocks[name];
  return unpacked(block);
}

const viewOf = (about, name) => about.views.find((view) => view.name === name);

/** The frame of a view whose LED stands nearest to a direction, as the object's middle sees it. */
function nearestFrame(view, middle, way) {
  const cosine = (frame) => dot(unit(minus(frame.at_mm, middle)), unit(way));
  return view.frames.reduce((best, frame) => cosine(frame) > cosine(best) ? frame : best);
}

/** The camera of the page where a view's camera was; it sees all of the object's box. */
function cameraOf(view, corners, width, height) {
  const forward = view.axes[2], shorter = Math.min(width, height);
  const target = add(view.camera_mm, times(forward, dot(minus(middleOf(corners), view.camera_mm), forward)));
  const [azimuth, elevation] = anglesOf(times(forward, -1));
  const camera = {
    target, azimuth, height: clamp(elevation, -89.999, 89.999), distance: length(minus(target, view.camera_mm)),
  };
  const { right, up, back } = axesOf(camera);
  const reaches = corners.map((corner) => {
    const way = minus(corner, view.camera_mm), depth = -dot(way, back);
    return Math.max(Math.abs(dot(way, right)) / (depth * width), Math.abs(dot(way, up)) / (depth * height));
  });
  return { ...camera, field: clamp(degrees(2 * Math.atan(1.1 * shorter * Math.max(...reaches))), 1, 120) };
}

const middleOf = (corners) => times(corners.reduce(add), 1 / corners.length);
