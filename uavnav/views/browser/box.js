/*
 * Drawing the box of tasks `space` and `space-moving` from above and from the side, as uavnav/envs/drawing.py draws it.
 * A place is [x, y, z], z upwards; a sphere [x, y, z, radius], with [vx, vy, vz] if it moves.
 */

const BETWEEN = 8; // the two views [px]
const VIEWS = [["from above", 0, 1, 2], ["from the side", 0, 2, 1]]; // axes: to the right, upwards, and looked along

function sizeOf({ width, depth, height }) {
  return [width, depth, height];
}

/** Width over height of a picture of both views. */
function shapeOf(world) {
  return (2 * world.width + BETWEEN) / Math.max(world.depth, world.height);
}

/** A drone's right, up and forward in the world, each [x, y, z]: of yaw y and pitch p [radians], uavnav/tasks/space.py. */
function bodyAxes({ yaw, pitch }) {
  const [level, climb] = [Math.cos(pitch), Math.sin(pitch)];
  const [cosine, sine] = [Math.cos(yaw), Math.sin(yaw)];
  return [[sine, -cosine, 0], [-climb * cosine, -climb * sine, level], [level * cosine, level * sine, climb]];
}

/** Where spheres are at a step: each coordinate bounces off the walls' outer side. */
function spheresAt(world, spheres, steps) {
  const size = sizeOf(world);
  return spheres.map(([x, y, z, radius, ...speeds]) => {
    const now = [x, y, z].map((from, axis) => (speeds.length ? reflect(from, speeds[axis], steps, size[axis])[0] : from));
    return [...now, radius];
  });
}

/** The slice through the drone's centre is dark; a sphere before or behind it is pale, less so where it may be touched. */
function drawSpheres(context, world, spheres, place, [, right, up, along], colours) {
  context.fillStyle = colours.obstacle;
  const away = (sphere) => Math.abs(sphere[along] - place[along]);
  for (const sphere of spheres) {
    context.globalAlpha = away(sphere) < sphere[3] + world.drone_radius ? 0.35 : 0.12;
    disc(context, sphere[right], sphere[up], sphere[3]);
  }
  context.globalAlpha = 1;
  for (const sphere of spheres.filter((one) => away(one) < one[3])) {
    disc(context, sphere[right], sphere[up], Math.sqrt(sphere[3] ** 2 - away(sphere) ** 2));
  }
}

function drawView(context, wide, { world, spheres, drone, colours, font }, view) {
  const [title, right, up] = view;
  const [scale, high] = [wide / world.width, sizeOf(world)[up]];
  const seen = (point) => [point[right], point[up]];
  context.beginPath();
  context.rect(0, 0, wide, scale * high);
  context.clip();
  context.fillStyle = colours.bg;
  context.fillRect(0, 0, wide, scale * high);
  context.save();
  context.transform(scale, 0, 0, -scale, 0, scale * high);
  context.lineCap = context.lineJoin = "round";
  drawSpheres(context, world, spheres, drone.place, view, colours);
  drawBorder(context, { ...world, height: high }, colours);
  const thick = Math.max(1, 0.6 / scale);
  const [[x, y], nose] = [seen(drone.place), seen(drone.axes[2])];
  const pose = { x, y, angle: Math.atan2(nose[1], nose[0]), reach: Math.hypot(...nose) };
  const around = pose.reach < 1e-6 ? { ...world, sensor_arc: 360 } : world; // it looks along the view
  const flat = { pose, trail: drone.trail.map(seen), sensed: drone.sensed.map(seen), crashed: drone.crashed };
  drawFlight(context, around, flat, thick, colours);
  context.restore();
  context.font = font;
  context.textBaseline = "top";
  const [corner, width] = [scale * world.border + 3, context.measureText(title).width];
  context.fillStyle = colours.bg;
  context.fillRect(corner - 2, corner - 2, width + 4, 16);
  context.fillStyle = colours.fg;
  context.fillText(title, corner, corner);
}

/** Both views of a box, its spheres and a drone: its place, axes, the trail that it flew, what it senses, and `crashed`. */
function drawBox(canvas, scene) {
  const { context, width } = fit(canvas);
  const wide = (width - BETWEEN) / 2;
  VIEWS.forEach((view, nth) => {
    context.save();
    context.translate(nth * (wide + BETWEEN), 0);
    drawView(context, wide, scene, view);
    context.restore();
  });
}
