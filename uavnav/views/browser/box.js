/*
 * The box of `space` and `space-moving` from above and from the side, as uavnav/envs/drawing.py draws it.
 * A place is [x, y, z], z upwards; a sphere [x, y, z, radius], with [vx, vy, vz] if it moves.
 */

const VIEWS = [[0, 1, 2], [0, 2, 1]]; // from above, from the side: axes to the right, upwards, looked along

function sizeOf({ width, depth, height }) { return [width, depth, height]; }

/** A drone's right, up and forward in the world, each [x, y, z], by its yaw and pitch [radians]: space.py. */
function bodyAxes({ yaw, pitch }) {
  const [level, climb] = [Math.cos(pitch), Math.sin(pitch)];
  const [cosine, sine] = [Math.cos(yaw), Math.sin(yaw)];
  return [[sine, -cosine, 0], [-climb * cosine, -climb * sine, level], [level * cosine, level * sine, climb]];
}

/** Where spheres are at a step: each coordinate bounces off the walls' outer side. */
function spheresAt(world, spheres, steps) {
  const size = sizeOf(world);
  return spheres.map(([x, y, z, radius, ...speeds]) => {
    const now = [x, y, z].map((from, axis) => reflect(from, speeds[axis] ?? 0, steps, size[axis])[0]);
    return [...now, radius];
  });
}

/**
 * A view of a box as drawArena takes it; the drone as droneAt has it. The slice through the drone's centre is
 * dark; a sphere before or behind it is pale, less so where it may be touched.
 */
function viewOf([right, up, along], { world, spheres, drone }) {
  const seen = (point) => [point[right], point[up]];
  const away = (sphere) => Math.abs(sphere[along] - drone.place[along]);
  const opacity = (sphere) => (away(sphere) < sphere[3] + world.drone_radius ? 0.35 : 0.12);
  const pale = spheres.map((sphere) => [...seen(sphere), sphere[3], opacity(sphere)]);
  const sliced = spheres.filter((sphere) => away(sphere) < sphere[3]);
  const circles = sliced.map((sphere) => [...seen(sphere), Math.sqrt(sphere[3] ** 2 - away(sphere) ** 2)]);
  const [[x, y], nose] = [seen(drone.place), seen(drone.axes[2])];
  const pose = { x, y, angle: Math.atan2(nose[1], nose[0]), reach: Math.hypot(...nose) };
  const flat = { pose, trail: drone.trail.map(seen), sensed: drone.sensed.map(seen), crashed: drone.crashed };
  const sensor_arc = pose.reach < 1e-6 ? 360 : world.sensor_arc; // it looks along the view
  return { world: { ...world, height: sizeOf(world)[up], sensor_arc }, pale, circles, drones: [flat] };
}
