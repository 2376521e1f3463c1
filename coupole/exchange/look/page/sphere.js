// The sphere of lights: the half of all directions that looks to the camera, with a dot for each light.

const DOT_PX = 11;

/** A light's direction as the camera has it: right, up, towards it. */
function inView(camera, way) {
  const { right, up, back } = axesOf(camera), there = unit(way);
  return [dot(there, right), dot(there, up), dot(there, back)];
}

/** The direction in the object's frame of a place on the sphere, -1 to 1 each way; outside of it the rim. */
function wayOn(camera, x, y) {
  const { right, up, back } = axesOf(camera), reach = Math.hypot(x, y);
  const [a, b] = reach > 1 ? [x / reach, y / reach] : [x, y];
  const z = Math.sqrt(Math.max(0, 1 - a * a - b * b));
  return unit(add(add(times(right, a), times(up, b)), times(back, z)));
}

/** Azimuth and height over the support, degrees. */
function anglesOf(way) {
  const there = unit(way);
  return [degrees(Math.atan2(there[1], there[0])), degrees(Math.asin(clamp(there[2], -1, 1)))];
}

function wayOf(azimuth, height) {
  const a = radians(azimuth), h = radians(height);
  return [Math.cos(h) * Math.cos(a), Math.cos(h) * Math.sin(a), Math.sin(h)];
}

const LED_PX = 1.6;

/** LEDs of a run: with a frame filled, without one crosses, hidden ones rings; the nearest to the light larger. */
function drawDome(context, camera, { proven, unproven, hidden, nearest }, middle, radius) {
  const at = (way) => {
    const [x, y] = inView(camera, way);
    return [middle + x * radius, middle - y * radius];
  };
  const dot = (way, size) => {
    context.beginPath();
    context.arc(...at(way), size, 0, 2 * Math.PI);
  };
  context.fillStyle = context.strokeStyle = "#9fd8cf";
  context.lineWidth = 1;
  for (const way of proven) {
    dot(way, LED_PX);
    context.fill();
  }
  for (const way of hidden) {
    dot(way, LED_PX + 0.5);
    context.stroke();
  }
  context.strokeStyle = "#ff8a7a";
  for (const way of unproven) {
    const [x, y] = at(way), arm = LED_PX + 1;
    context.beginPath();
    for (const side of [-arm, arm]) {
      context.moveTo(x - arm, y - side);
      context.lineTo(x + arm, y + side);
    }
    context.stroke();
  }
  context.strokeStyle = "#ffffff";
  context.lineWidth = 2;
  dot(nearest, LED_PX + 3);
  context.stroke();
}

/** `dome` are LEDs of a run; none of other pages. */
function drawSphere(canvas, camera, lights, chosen, dome) {
  const context = canvas.getContext("2d"), size = canvas.width, middle = size / 2, radius = middle - DOT_PX;
  context.clearRect(0, 0, size, size);
  const shade = context.createRadialGradient(middle * 0.8, middle * 0.75, 0, middle, middle, radius);
  shade.addColorStop(0, "#4a5160");
  shade.addColorStop(1, "#1d212a");
  context.fillStyle = shade;
  context.strokeStyle = "#78839a";
  context.beginPath();
  context.arc(middle, middle, radius, 0, 2 * Math.PI);
  context.fill();
  context.stroke();
  if (dome) drawDome(context, camera, dome, middle, radius);
  lights.forEach((light, number) => {
    const [x, y, z] = inView(camera, light.direction);
    context.globalAlpha = z < 0 ? 0.35 : 1;
    context.fillStyle = light.colour;
    context.strokeStyle = number === chosen ? "#ffd27a" : "#0e1014";
    context.lineWidth = number === chosen ? 4 : 2;
    context.beginPath();
    context.arc(middle + x * radius, middle - y * radius, DOT_PX - 3, 0, 2 * Math.PI);
    context.fill();
    context.stroke();
    context.fillStyle = "#14161b";
    context.font = `bold ${DOT_PX}px sans-serif`;
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.fillText(String(number + 1), middle + x * radius, middle - y * radius + 0.5);
  });
  context.globalAlpha = 1;
}
