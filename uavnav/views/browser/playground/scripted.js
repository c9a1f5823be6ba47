/*
 * The scripted policies of uavnav/tasks/baselines.py: functions of what is sensed.
 */

const MARGIN = 0.01; // [px] against rounding

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

/** Turn to the free direction that is nearest to the goal's, and fly as far as is certainly safe. */
function towardsGoal(world, observation, { scale, bearings, look, spare }) {
  const [right, forward, away] = observation.subarray(3 * world.n_slots);
  const echoes = echoesIn(world, observation).filter(hasDirection);
  const reach = Math.min(away * scale, look);
  const isFree = (bearing) =>
    echoes.every((echo) => {
      const along = echo.right * Math.sin(radians(bearing)) + echo.forward * Math.cos(radians(bearing));
      const flown = clamp(echo.distance * along, 0, reach); // where it is nearest
      const nearest = Math.sqrt(echo.distance ** 2 - 2 * flown * echo.distance * along + flown ** 2);
      return nearest > world.drone_radius + spare || along <= 0;
    });
  const goal = Math.atan2(right, forward) / radians(1);
  const free = bearings.filter(isFree).map((bearing) => [Math.abs(bearing - goal), bearing]);
  const wanted = free.length ? free.reduce((one, other) => (other[0] < one[0] ? other : one))[1] : -90;
  const left = Math.floor(world.n_turns / 2);
  const angle = clamp(-wanted, left + 1 - world.n_turns, left);
  const rooms = echoes.map((echo) => {
    const closing = -echo.right * Math.sin(radians(angle)) + echo.forward * Math.cos(radians(angle));
    return closing > 0 ? (echo.distance - world.drone_radius - MARGIN) / closing : Infinity;
  });
  const safe = Math.floor(clamp(Math.min(...rooms), 0, world.n_distances - 1));
  return encode(world, [angle, Math.abs(wanted) >= 45 ? 0 : safe]);
}

/** The first action of the way that keeps most clear of what is in view, also if that comes nearer by itself. */
function dodge(world, observation, { ways, body, drift, enough }) {
  const echoes = echoesIn(world, observation).filter(hasDirection);
  const centres = echoes.map(({ right, forward, distance }) => [right * (distance + body), forward * (distance + body)]);
  let [chosen, most] = [0, -Infinity];
  for (const [places, first, worth] of ways) {
    let clear = enough;
    places.forEach(([x, y], nth) => {
      for (const [cx, cy] of centres) {
        const apart = Math.sqrt((x - cx) ** 2 + (y - cy) ** 2);
        clear = Math.min(clear, apart - body - world.drone_radius - drift * (nth + 1));
      }
    });
    if (clear + worth > most) [chosen, most] = [first, clear + worth];
  }
  return chosen;
}

/** What `reactive` does in each world: of its constants, an observation, and the `rules` of that world. */
const REACTIONS = { drone: reactive, slalom: reactive, moving: dodge, goal: towardsGoal };
const REACTIVE = "reactive";

/** Every scripted policy: of a world's name, its task, an observation and uniform random numbers, an action. */
const SCRIPTED = {
  [REACTIVE]: (name, { world, rules }, observation) => REACTIONS[name](world, observation, rules),
  straight: (name, { world }) => encode(world, [0, world.n_distances - 1]),
  random: (name, { world }, observation, draw) => Math.floor(world.n_turns * world.n_distances * draw()),
};
