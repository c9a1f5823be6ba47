/*
 * The hand-written rules of uavnav/tasks/baselines.py, one for each world: functions of what is sensed alone.
 */

const MARGIN = 0.01; // [px] against rounding
const RADIANS = Math.PI / 180;

/** The slots, each as { right, forward, distance [px] }. */
function echoesIn(world, observation) {
  const span = world.sensor_radius - world.drone_radius;
  const echo = ([right, forward, proximity]) => ({ right, forward, distance: f32(world.drone_radius + f32(proximity * span)) });
  return slotsOf(world, observation).map(echo);
}

const hasDirection = ({ right, forward }) => right !== 0 || forward !== 0; // an empty slot has none

/** Fly straight at full speed where that is certainly safe, else turn left on the spot. */
function reactive(world, observation) {
  const full = world.n_distances - 1;
  const safe = echoesIn(world, observation).every(
    ({ forward, distance }) => f32(distance - f32(full * forward)) > f32(world.drone_radius + MARGIN),
  );
  return encode(world, safe ? [0, full] : [Math.floor(world.n_turns / 2), 0]);
}

// ---------------------------------------------------------------------------------------------- a goal

const BEARINGS = Array.from({ length: 37 }, (_, nth) => 5 * nth - 90); // [degrees] to the right of the heading
const LOOK = 60; // [px] that must be free in a direction
const ROOM = 2; // [px] beyond the drone's own radius

/** Turn to the free direction that is nearest to the goal's, and fly as far as is certainly safe. */
function towardsGoal(world, observation, { scale }) {
  const [right, forward, away] = observation.subarray(3 * world.n_slots);
  const echoes = echoesIn(world, observation).filter(hasDirection);
  const reach = Math.min(away * scale, LOOK);
  const isFree = (bearing) =>
    echoes.every((echo) => {
      const along = echo.right * Math.sin(bearing * RADIANS) + echo.forward * Math.cos(bearing * RADIANS);
      const flown = clamp(echo.distance * along, 0, reach); // where it is nearest
      const nearest = Math.sqrt(echo.distance ** 2 - 2 * flown * echo.distance * along + flown ** 2);
      return nearest > world.drone_radius + ROOM || along <= 0;
    });
  const goal = Math.atan2(right, forward) / RADIANS;
  const free = BEARINGS.filter(isFree).map((bearing) => [Math.abs(bearing - goal), bearing]);
  const wanted = free.length ? free.reduce((one, other) => (other[0] < one[0] ? other : one))[1] : -90;
  const left = Math.floor(world.n_turns / 2);
  const angle = clamp(-wanted, left + 1 - world.n_turns, left);
  const rooms = echoes.map((echo) => {
    const closing = -echo.right * Math.sin(angle * RADIANS) + echo.forward * Math.cos(angle * RADIANS);
    return closing > 0 ? (echo.distance - world.drone_radius - MARGIN) / closing : Infinity;
  });
  const safe = Math.floor(clamp(Math.min(...rooms), 0, world.n_distances - 1));
  return encode(world, [angle, Math.abs(wanted) >= 45 ? 0 : safe]);
}

// ---------------------------------------------------------------------------------------------- obstacles that move

const STEPS = 16; // that a way is looked ahead
const TURNING = [0, 1, 3, 8, 18, 36]; // steps of a way that turn, before it goes straight on at full speed
const PACES = [0, 3, 6, 9]; // [px a step] while it turns
const BODY = 60; // [px] radius that a sensed body is taken to have
const DRIFT = 0.5; // [px a step] that a body may come nearer by itself
const ENOUGH = 40; // [px] of clearance, beyond which more is worth nothing
const waysOf = new WeakMap(); // worlds -> their ways

/** Ways to fly: { places: [right, forward] px of each step, first: the first action, worth: [px] }. */
function ways(world) {
  if (waysOf.has(world)) return waysOf.get(world);
  const left = Math.floor(world.n_turns / 2);
  const found = [];
  for (const turn of [left, left + 1 - world.n_turns]) {
    for (const turning of TURNING) {
      for (const pace of PACES.filter((one) => one > 0 || turning > 0)) {
        const [places, at] = [[], [0, 0]];
        for (let step = 1; step <= STEPS; step += 1) {
          const heading = turn * Math.min(step, turning) * RADIANS;
          const pixels = step <= turning || turning === 0 ? pace : world.n_distances - 1;
          at[0] -= pixels * Math.sin(heading);
          at[1] += pixels * Math.cos(heading);
          places.push([...at]);
        }
        found.push({ places, first: encode(world, [turning > 0 ? turn : 0, pace]), worth: 0.1 * Math.hypot(...at) });
      }
    }
  }
  waysOf.set(world, found);
  return found;
}

/** The first action of the way that keeps most clear of what is in view, also if that comes nearer by itself. */
function dodge(world, observation) {
  const echoes = echoesIn(world, observation).filter(hasDirection);
  const centres = echoes.map(({ right, forward, distance }) => [right * (distance + BODY), forward * (distance + BODY)]);
  let [chosen, most] = [0, -Infinity];
  for (const { places, first, worth } of ways(world)) {
    let clear = ENOUGH;
    places.forEach(([x, y], nth) => {
      for (const [cx, cy] of centres) {
        const apart = Math.sqrt((x - cx) ** 2 + (y - cy) ** 2);
        clear = Math.min(clear, apart - BODY - world.drone_radius - DRIFT * (nth + 1));
      }
    });
    if (clear + worth > most) [chosen, most] = [first, clear + worth];
  }
  return chosen;
}

/** Each of a world, an observation, and the `rules` of its sets. */
const RULES = { drone: reactive, slalom: reactive, moving: dodge, goal: towardsGoal };
