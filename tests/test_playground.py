"""The playground's worlds, policies, scripted policies and layouts, in a real browser by the page's own
code, against Python's.
"""

import base64
import itertools

import numpy as np
import pandas as pd
import pytest
import torch
from browsing import CONFIGURATIONS, RESULTS, ask
from policies_by_hand import untrained

from uavnav import load_policy
from uavnav.acting import HEADS, values_of
from uavnav.networks import ACTIVATIONS, BUILT_IN
from uavnav.runs import paper
from uavnav.runs.metrics import per_episode
from uavnav.tasks import goal, layouts, slalom
from uavnav.tasks.baselines import BASELINES, suited
from uavnav.tasks.dynamics import COSINE, SINE, decode
from uavnav.tasks.sensing import sense
from uavnav.tasks.state import COUNTS
from uavnav.tasks.table import make_task, name_of
from uavnav.tasks.world import World
from uavnav.views.browser import playground

pytestmark = pytest.mark.slow

POSES, SETS = 2000, 40
CLOSE = 1e-4
FAULTS = {"noise": 5.0, "lost": 0.2, "late": 2, "sticky": 0.25}
PACKED = """
const packed = (numbers) => {
  const bytes = new Uint8Array(Float32Array.from(numbers).buffer);
  let text = "";
  for (let at = 0; at < bytes.length; at += 8192)
    text += String.fromCharCode(...bytes.subarray(at, at + 8192));
  return btoa(text);
};
"""  # numbers on their way out of a browser
SENSED = (
    PACKED
    + """
const [name, poses, shown] = arguments;
const task = new TASKS[name](playground.data.tasks[name]);
const at = ([x, y, heading, , steps]) => ({ x, y, heading, steps, waited: 0 });
const seen = poses.map((pose) => task.observe(at(pose), shown[pose[3]]));
return [packed(seen.flatMap(({ observation }) => [...observation])),
  packed(seen.map(({ clearance }) => clearance))];
"""
)
FLOWN = (
    PACKED
    + """
const [name, episodes, shown, limit, faults] = arguments;
const task = new TASKS[name]({ ...playground.data.tasks[name], max_steps: limit }, faults ?? NO_FAULTS);
return episodes.map(([place, actions, draws]) => {
  let state = task.start(shown[place], draws?.[0]);
  const rows = [];
  const seen = [...task.observe(state, shown[place]).observation];
  actions.forEach((action, nth) => {
    const after = task.step(state, action, shown[place], draws?.[nth + 1]);
    state = after.state;
    rows.push(state.x, state.y, state.heading, after.clearance, state.reward);
    rows.push(Number(after.ended === "collision"));
    rows.push(Number(after.ended === "goal"), Number(after.ended === "time-out"));
    seen.push(...after.observation);
  });
  const reached = playground.data.metrics.map((metric) => metricOf(metric, state));
  return [packed(rows), packed(seen), reached];
});
"""
)
CHOSEN = (
    PACKED
    + """
const [seen, uniforms] = arguments;
const observations = seen.map((row) => Float32Array.from(row));
return playground.data.policies.filter(({ key }) => key.endsWith("-0")).map((policy) => {
  const [values_of, fly] = [network(policy), (...asked) => think(policy, ...asked)];
  const drawn = (place) => { let next = 0; return () => uniforms[next++][place]; };
  const values = observations.map((one) => values_of(one).values);
  const greedy = values.map(best);
  const sampled = values.map((one, place) => ACTS[policy.acts](one, policy.epsilon, drawn(place)));
  const flown = observations.slice(0, 100).map((one, place) =>
    [fly(one, null, true).action, fly(one, drawn(place), false).action]);
  return [policy.key, packed(values.slice(0, 200).flatMap((one) => [...one])), greedy, sampled, flown];
});
"""
)


def unpacked(text, *shape):
    return torch.from_numpy(np.frombuffer(base64.b64decode(text), "<f4").copy()).reshape(shape)


# -- the worlds ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def all_layouts():
    return layouts.load("test")[:SETS]


@pytest.fixture(scope="module", params=["drone", "moving", "goal"])
def task(request):
    """A world on the first layouts of its split."""
    whole = make_task("test", task=request.param)
    return whole.replace(layouts=whole.layouts[:SETS])


def layouts_of(task):
    """A layout file as world.js has them."""
    rows = task.layouts.double().tolist()
    return [
        {"circles": one[:-1], "goal": one[-1][:2]} if name_of(task) == "goal" else {"circles": one}
        for one in rows
    ]


@pytest.fixture(scope="module")
def poses():
    """x, y [px], heading, layout: anywhere, also in walls; a third on whole tens, where distances tie."""
    random = torch.Generator().manual_seed(17)
    x, y = (torch.rand(POSES, generator=random) * (side + 20) - 10 for side in (800, 600))
    heading = torch.randint(360, (POSES,), generator=random)
    ties = torch.arange(POSES) % 3 == 0
    x, y = (torch.where(ties, 10 * (place / 10).round(), place) for place in (x, y))
    heading = torch.where(ties, 90 * (heading // 90), heading)
    return x, y, heading, torch.arange(POSES) % SETS


def placed(task, poses):
    """The states at poses, after 0 to 100,000 steps."""
    x, y, heading, places = poses
    steps = torch.randint(100_000, (POSES,), generator=torch.Generator().manual_seed(8))
    return task.start(places, heading)._replace(x=x, y=y, steps=steps)


def test_2000_poses_are_sensed_as_by_python_within_a_ten_thousandth(chrome, opened, task, poses):
    state = placed(task, poses)
    seen, clearance = task.observe(state)
    rows = torch.stack(
        [state.x.double(), state.y.double(), state.heading, state.layout, state.steps], 1
    ).tolist()
    rows = [[*row[:2], *map(int, row[2:])] for row in rows]
    mine, near = chrome.execute_script(SENSED, name_of(task), rows, layouts_of(task))
    assert (unpacked(mine, *seen.shape) - seen).abs().max() <= CLOSE
    assert (unpacked(near, POSES) - clearance).abs().max() <= CLOSE
    filled = (seen[:, 2:30:3] < 1).sum(1)
    assert {0, 1, 10} <= set(filled.tolist())  # empty, alone, and more than there is room for
    assert 0.2 < (clearance <= 30).float().mean() < 0.9


def test_every_cosine_and_every_action_is_pythons(chrome, opened):
    assert ask(chrome, "[...COSINES]") == COSINE.double().tolist()
    assert ask(chrome, "[...SINES]") == SINE.double().tolist()
    angle, distance = decode(torch.arange(100), World())
    every = "Array.from({ length: 100 }, (_, action) => action)"
    assert (
        ask(chrome, f"{every}.map((one) => decode(playground.world, one))")
        == torch.stack([angle, distance], 1).tolist()
    )
    assert ask(chrome, f"{every}.map((one) => encode(playground.world, decode(playground.world, one)))") == [
        *range(100)
    ]


def committed():
    """Episodes of the eight configurations, six each, and two of scripted policies: [layout, actions]; and
    the rows of the configurations'.
    """
    episodes, rows = [], []
    for configuration in CONFIGURATIONS:
        steps = pd.read_parquet(RESULTS / "vectorised" / configuration / "behaviour.parquet")
        evaluated = pd.read_parquet(RESULTS / "vectorised" / configuration / "evaluation.parquet")
        for mode, seed in (("greedy", 0), ("sampled", 1)):
            watched, flown = (
                one[(one["mode"] == mode) & (one["seed"] == seed)] for one in (steps, evaluated)
            )
            for place in range(3):
                episodes.append([place, watched["action"][watched["layout"] == place].tolist()])
                rows.append(flown[flown["layout"] == place])
    for name in ("random", "reactive"):
        task, actions = make_task("test"), []
        state, random = task.start(torch.tensor([7]), torch.tensor([90])), torch.Generator().manual_seed(0)
        for _ in range(200):
            action = BASELINES[name](task.observe(state)[0], random)
            actions.append(int(action))
            state, outcome = task.step(state, action)
            if outcome.terminated:
                break
        episodes.append([7, actions])
    return episodes, pd.concat(rows, ignore_index=True)


def in_order(observations):
    """Slots [..., 10, 3] in the order of their right components, whatever their distances."""
    slots = observations[..., :30].unflatten(-1, (10, 3))
    return slots.gather(-2, slots[..., :1].argsort(-2).expand_as(slots))


def in_python(task, places, actions, draws=None):
    """Episodes of given actions [F, T] on shown [F] until all have ended: observations, poses, counts,
    ends [F, time].
    """
    state = task.start(places, torch.full_like(places, 90), None if draws is None else draws[:, 0])
    seen, poses, counts, ends = [task.observe(state)[0]], [], [], []
    for nth, action in enumerate(actions.T):
        state, outcome = task.step(state, action, None if draws is None else draws[:, nth + 1])
        reached = (
            task.succeeded(state) if name_of(task) == "goal" else torch.zeros(len(places), dtype=torch.bool)
        )
        pose = state.x, state.y, state.heading, outcome.clearance, state.reward
        seen.append(outcome.observation)
        poses.append(torch.stack([*pose, outcome.terminated & ~reached, reached, outcome.truncated], -1))
        counts.append(torch.stack([getattr(state, name).double() for name in COUNTS], -1))
        ends.append(outcome.terminated | outcome.truncated)
        if torch.stack(ends).any(0).all():
            break
    return *(torch.stack(one, 1) for one in (seen, poses, counts)), torch.stack(ends, 1)


def test_50_episodes_of_committed_actions_are_flown_as_by_python_and_end_as_their_rows_say(
    chrome, opened, task
):
    given, rows = committed()
    longest = max(len(actions) for _, actions in given)
    padded = torch.tensor([actions + [0] * (longest - len(actions)) for _, actions in given])
    places = torch.tensor([place for place, _ in given])
    seen, poses, counts, ends = in_python(task, places, padded)
    last = torch.where(ends.any(1), ends.int().argmax(1) + 1, ends.shape[1]).tolist()
    episodes = [[place, actions[:end]] for (place, actions), end in zip(given, last, strict=True)]
    found = chrome.execute_script(FLOWN, name_of(task), episodes, layouts_of(task), task.max_steps)
    assert len(episodes) == len(found) == 50
    observed = swapped = crashed = 0
    for place, ((_, actions), (mine, sensed, metrics)) in enumerate(zip(episodes, found, strict=True)):
        n = len(actions)
        assert (unpacked(mine, n, 8) - poses[place, :n]).abs().max() <= CLOSE
        here, there = unpacked(sensed, n + 1, seen.shape[-1]), seen[place, : n + 1]
        assert torch.allclose(here[:, 30:], there[:, 30:], rtol=0, atol=CLOSE)
        other = ((here - there).abs() > CLOSE).any(-1)
        assert torch.allclose(in_order(here[other]), in_order(there[other]), rtol=0, atol=CLOSE)
        observed, swapped = observed + n + 1, swapped + int(other.sum())
        counted = pd.DataFrame(counts[place, n - 1 : n].numpy(), columns=list(COUNTS))
        assert metrics == pytest.approx(per_episode(counted)[list(paper.COLUMNS)].iloc[0].tolist(), abs=CLOSE)
        crashed += bool(poses[place, n - 1, 5])
        of_row = name_of(task) == "drone" and place < len(rows)
        if of_row and rows["terminated"][place] and rows["steps"][place] == n:
            assert metrics == pytest.approx(
                per_episode(rows)[list(paper.COLUMNS)].iloc[place].tolist(), abs=CLOSE
            )
            assert poses[place, n - 1, 5]
    assert crashed >= 10
    assert swapped <= max(1, observed / 1000), (
        "neighbours at one distance, which square roots round otherwise"
    )


# -- who flies -----------------------------------------------------------------------------------------------


def test_policies_choose_as_in_python_in_999_of_1000_poses_and_reactive_in_all(
    chrome, opened, all_layouts, poses
):
    x, y, heading, places = poses
    seen = sense(x, y, heading, all_layouts[places], World())[0].flatten(1)
    uniforms = torch.rand(2, POSES, generator=torch.Generator().manual_seed(3))
    found = chrome.execute_script(CHOSEN, seen.double().tolist(), uniforms.double().tolist())
    assert [key for key, *_ in found] == [
        f"{configuration.replace('/', '-')}-0" for configuration in CONFIGURATIONS
    ]
    for configuration, (_, values, greedy, sampled, flown) in zip(CONFIGURATIONS, found, strict=True):
        policy = load_policy(RESULTS / "vectorised" / configuration, 0, greedy=False)
        expected = policy.values(seen)
        numbers = uniforms[: len(policy.draw((1,)))]
        assert (unpacked(values, 200, 100) - expected[:200]).abs().max() <= CLOSE
        assert flown == [[*both] for both in zip(greedy[:100], sampled[:100], strict=True)]
        assert (torch.tensor(greedy) == expected.argmax(-1)).float().mean() >= 0.999
        acted = policy.choose(expected, numbers)
        assert (torch.tensor(sampled) == acted).float().mean() >= 0.999
        assert (acted != expected.argmax(-1)).float().mean() > 0.01
    words = "arguments[0].map((one) => reactive(playground.world, Float32Array.from(one)))"
    mine = chrome.execute_script(f"return {words}", seen.double().tolist())
    assert mine == BASELINES["reactive"](seen).tolist()
    assert len({*mine}) == 2


def test_every_activation_of_the_package_is_pytorchs_within_a_millionth(chrome, opened):
    x = torch.linspace(-8, 8, 161)
    layers = ask(chrome, "Object.keys(LAYERS)")
    known = {name: ACTIVATIONS[name] for name in BUILT_IN if name not in layers}
    found = chrome.execute_script(
        "const [x] = arguments; const all = Object.entries(ACTIVATIONS);"
        "return Object.fromEntries(all.map(([name, act]) => [name, x.map((one) => act(one))]));",
        x.double().tolist(),
    )
    assert {*found} == {*known}
    for name, act in known.items():
        assert (torch.tensor(found[name]) - act(x)).abs().max() <= 2e-6, name
    normal = torch.nn.functional.layer_norm(x, x.shape)
    assert (
        torch.tensor(ask(chrome, f"[...normalised(Float32Array.from({x.tolist()}))]")).sub(normal).abs().max()
        <= 1e-5
    )


def test_networks_of_layers_give_what_they_give_in_python(chrome, opened):
    """Each behind LayerNorm, with coefficients that are not those of the beginning."""
    observation = torch.rand(30, generator=torch.Generator().manual_seed(1))
    for name in ask(chrome, "Object.keys(LAYERS)"):
        policy = untrained(activation=name, sizes=(30, 16, 12, 100), layer_norm=True)
        with torch.no_grad():
            for number, learned in enumerate(policy.network.parameters()):
                learned.add_(
                    0.2 * torch.randn(learned.shape, generator=torch.Generator().manual_seed(number))
                )
        code = "return [...network(arguments[0])(Float32Array.from(arguments[1])).values]"
        found = torch.tensor(
            chrome.execute_script(code, playground._packed(policy, "", 0), observation.tolist())
        )
        assert (found - policy.values(observation)).abs().max() <= 2e-5, name


@pytest.mark.parametrize(
    "head", ["direct", "dueling", "distribution -10 9 51", "dueling-distribution -10 4.5 21"]
)
def test_outputs_are_read_as_one_number_an_action_as_in_python(head, chrome, opened):
    """With logits from -20 to 20, so that some atoms have nearly all of the probability."""
    name, *numbers = head.split()
    count = (100 + ("dueling" in name)) * int((numbers or [1])[-1])
    outputs = 40 * torch.rand(count, generator=torch.Generator().manual_seed(0)) - 20
    read = f"[...HEADS['{name}']({', '.join(['Float32Array.from(arguments[0])', *numbers])})]"
    mine = torch.tensor(chrome.execute_script(f"return {read}", outputs.double().tolist()))
    assert mine.shape == (100,)
    assert ask(chrome, "Object.keys(HEADS)") == [*HEADS]
    assert (mine - values_of(head, outputs)).abs().max() <= 2e-5


def test_layouts_of_obstacles_leave_the_start_free_and_are_spread_as_pythons(chrome, opened):
    made = "Array.from({ length: 500 }, (_, seed) => generate(playground.world, 8, seed))"
    all_layouts = torch.tensor(ask(chrome, made))
    layouts.validate(all_layouts)  # radii, window, safe zone
    x, y, radius = all_layouts.flatten(0, 1).T
    theirs = layouts.generate(500, 8, 0).flatten(0, 1)
    for mine, other, spread in zip((x, y, radius), theirs.T, (800, 600, 70), strict=True):
        assert abs(mine.mean() - other.mean()) < 0.03 * spread
        assert abs(mine.std() - other.std()) < 0.03 * spread
    assert len({tuple(row) for row in all_layouts.flatten(1).tolist()}) == 500
    assert ask(chrome, "generate(playground.world, 16, 5).slice(0, 8)") == ask(
        chrome, "generate(playground.world, 8, 5)"
    )


# -- other worlds --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["drone", "moving", "goal"])
def test_with_the_same_random_numbers_faults_do_what_they_do_in_python(chrome, opened, name):
    task = make_task("test", task=name, faults=FAULTS)
    task, random = task.replace(layouts=task.layouts[:20]), torch.Generator().manual_seed(5)
    actions = torch.randint(100, (20, 60), generator=random)
    draws = task.draw(20 * 61, random).unflatten(0, (20, 61))
    seen, poses, _, ends = in_python(task, torch.arange(20), actions, draws)
    last = torch.where(ends.any(1), ends.int().argmax(1) + 1, 60).tolist()
    episodes = [[n, actions[n, :end].tolist(), draws[n].double().tolist()] for n, end in enumerate(last)]
    found = chrome.execute_script(FLOWN, name, episodes, layouts_of(task), task.max_steps, FAULTS)
    for n, (end, (mine, sensed, _)) in enumerate(zip(last, found, strict=True)):
        assert (unpacked(mine, end, 8) - poses[n, :end]).abs().max() <= CLOSE
        here, there = unpacked(sensed, end + 1, seen.shape[-1]), seen[n, : end + 1]
        assert torch.allclose(in_order(here), in_order(there), rtol=0, atol=CLOSE)
    assert sum(last) > 500
    without = in_python(make_task(task.layouts, task=name), torch.arange(20), actions)[0]
    differ = (without[:, :20] - seen[:, :20]).abs().amax((1, 2)) > 0.01
    assert differ.sum() >= 15  # negative control: without faults other things are seen


@pytest.mark.parametrize(
    ("name", "script"),
    [
        ("moving", "reactive"),
        ("goal", "reactive"),
        *itertools.product(["drone", "moving", "goal"], ["apf", "vfh"]),
    ],
)
def test_scripted_policies_choose_as_in_python_in_999_of_1000_poses(chrome, opened, name, script):
    task, random = make_task("test", task=name), torch.Generator().manual_seed(2)
    x, y = (torch.rand(2000, generator=random) * (side - 100) + 50 for side in (800, 600))
    heading, steps = (torch.randint(n, (2000,), generator=random) for n in (360, 1000))
    state = task.start(torch.arange(2000) % 1000, heading)._replace(x=x, y=y, steps=steps)
    seen = task.observe(state)[0]
    words = "const [script, name, seen] = arguments, task = playground.data.tasks[name];"
    words += "return seen.map((one) => SCRIPTED[script](name, task, Float32Array.from(one)));"
    mine = torch.tensor(chrome.execute_script(words, script, name, seen.double().tolist()))
    assert (mine == suited(BASELINES[script], task)(seen, None)).float().mean() >= 0.999
    assert len(mine.unique()) >= 10


def made(browser, task, n, **scene):
    """The random layouts 0 to n - 1 of a task."""
    words = "const [name, n, scene] = arguments; const task = new TASKS[name](playground.data.tasks[name]);"
    words += "return Array.from({ length: n }, (_, layout) => task.generate({ ...scene, layout }));"
    return browser.execute_script(words, task, n, scene)


@pytest.mark.parametrize("gap", [70, 160])
def test_each_column_of_a_slalom_has_one_gap_and_is_closed_elsewhere(chrome, opened, gap):
    middles = []
    for made_set in made(chrome, "slalom", 100, gap=gap):
        circles = np.array(made_set["circles"])
        assert {*circles[:, 2]} == {slalom.RADIUS}
        assert {*circles[:, 0]} == {*slalom.COLUMNS}
        for x in slalom.COLUMNS:
            y = np.sort(circles[circles[:, 0] == x, 1])
            between = np.diff(y) - 2 * slalom.RADIUS
            assert np.sort(between)[-1] == pytest.approx(gap, abs=1e-3)
            assert np.sort(between)[:-1].max() < 60  # closed to a drone
            assert (y[0], y[-1]) == (pytest.approx(0, abs=60), pytest.approx(600, abs=60))
            middles.append(y[between.argmax()] + slalom.RADIUS + gap / 2)
    low, high = 60 + gap / 2, 540 - gap / 2
    assert min(middles) >= low
    assert max(middles) <= high
    assert np.std(middles) == pytest.approx((high - low) / np.sqrt(12), rel=0.1)


def test_obstacles_that_move_are_those_of_the_papers_world_with_uniform_speeds_in_all_directions(
    chrome, opened
):
    standing, moving = made(chrome, "drone", 200, k=8), made(chrome, "moving", 200, k=8)
    circles = np.array([one["circles"] for one in moving])
    assert np.array_equal(circles[..., :3], [one["circles"] for one in standing])
    speed = np.hypot(circles[..., 3], circles[..., 4]).ravel()
    assert speed.max() <= 2
    assert (speed.mean(), speed.std()) == (
        pytest.approx(1, abs=0.05),
        pytest.approx(2 / np.sqrt(12), abs=0.03),
    )
    assert np.abs(circles[..., 3:].mean((0, 1))).max() < 0.1
    halved = ask(chrome, "withVelocities(generate(playground.world, 8, 5), 0, 1, 5)")
    assert np.allclose(2 * np.array(halved)[:, 3:], circles[5][:, 3:], atol=1e-6)


def test_every_goal_has_room_around_it_and_can_be_reached_also_among_20_obstacles(chrome, opened):
    for k, n in ((8, 30), (20, 5)):
        for one_set in made(chrome, "goal", n, k=k):
            place = np.array(one_set["goal"])
            circles = np.array(one_set["circles"], dtype=np.float32)
            assert len(circles) <= k
            goal.validate(torch.tensor([[*circles.tolist(), [*place.tolist(), 0.0]]]))
            lengths = goal.shortest_ways(circles, goal.GoalWorld())
            grid = np.stack(np.meshgrid(*(5 * np.arange(n) for n in lengths.shape), indexing="ij"), -1)
            assert np.isfinite(lengths[np.hypot(*np.moveaxis(grid - place, -1, 0)) <= 40]).any()
