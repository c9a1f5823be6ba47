"""The playground in a real browser: its world and its policies against Python's, and what a visitor sees and does."""

import base64
import json
from pathlib import Path

import axe_core_python
import numpy as np
import pandas as pd
import pytest
import torch
from browsing import FONTS, NARROW, PAIRS, WIDE, complaints, find, forget, one, press, requested, resize, theme, wait
from browsing import chrome as chrome
from selenium import webdriver
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select

from uavnav import load_policy
from uavnav.networks import ACTIVATIONS, KNOWN
from uavnav.playground import ACTIVATIONS as KNOWN_TO_THE_PAGE
from uavnav.playground import collect, page
from uavnav.runs import paper
from uavnav.runs.metrics import METRICS, per_episode
from uavnav.tasks import layouts
from uavnav.tasks.baselines import BASELINES
from uavnav.tasks.dynamics import COSINE, SINE, decode
from uavnav.tasks.sensing import sense
from uavnav.tasks.simulator import make_task
from uavnav.tasks.state import COUNTS
from uavnav.tasks.world import World

pytestmark = pytest.mark.slow

RESULTS = Path(__file__).parent.parent / "results"
CELLS = [f"{algorithm}/{activation}" for algorithm in ("ppo", "dqn") for activation in paper.ACTIVATIONS]
AXE = Path(axe_core_python.__file__).parent / "axe.min.js"
POSES, SETS = 2000, 40
CLOSE = 1e-4
PACKED = """
const packed = (numbers) => {
  const bytes = new Uint8Array(Float32Array.from(numbers).buffer);
  let text = "";
  for (let at = 0; at < bytes.length; at += 8192) text += String.fromCharCode(...bytes.subarray(at, at + 8192));
  return btoa(text);
};
"""  # numbers on their way out of a browser
SENSED = (
    PACKED
    + """
const [poses, bank] = arguments;
const seen = poses.map(([x, y, heading, set]) => sense(playground.world, { x, y, heading }, bank[set]));
return [packed(seen.flatMap(({ observation }) => [...observation])), packed(seen.map(({ clearance }) => clearance))];
"""
)
FLOWN = (
    PACKED
    + """
const [flights, bank] = arguments;
const world = playground.world;
return flights.map(([set, actions]) => {
  let state = start(world);
  const rows = [];
  const seen = [...sense(world, state, bank[set]).observation];
  for (const action of actions) {
    const after = step(world, state, action, bank[set]);
    state = after.state;
    rows.push(state.x, state.y, state.heading, after.clearance, state.reward, Number(after.collided));
    seen.push(...after.observation);
  }
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
  const [think, fly] = [network(policy), thinker(policy)];
  const drawn = (place) => { let next = 0; return () => uniforms[next++][place]; };
  const values = observations.map((one) => think(one).values);
  const greedy = values.map(best);
  const sampled = values.map((one, place) => ACTS[policy.acts](one, policy.epsilon, drawn(place)));
  const flown = observations.slice(0, 100).map((one, place) =>
    [fly(one, null, true).action, fly(one, drawn(place), false).action]);
  return [policy.key, packed(values.slice(0, 200).flatMap((one) => [...one])), greedy, sampled, flown];
});
"""
)


@pytest.fixture(scope="module")
def opened(chrome, tmp_path_factory):
    """The page of the committed cells, in a folder of its own."""
    path = tmp_path_factory.mktemp("playground") / "playground.html"
    path.write_text(page(collect([RESULTS])[0]))
    forget(chrome)
    visit(chrome, path)
    return path


def visit(browser, path, fragment="", width=WIDE, colours="light", motion="reduce"):
    """The page, freshly opened; with reduced motion nothing moves by itself."""
    resize(browser, width)
    theme(browser, colours, motion)
    browser.get("about:blank")
    browser.get(path.as_uri() + fragment)


@pytest.fixture
def browser(chrome, opened):
    """The page as a visitor without a link gets it; it makes no request and no complaint."""
    forget(chrome)
    visit(chrome, opened)
    yield chrome
    assert complaints(chrome) == []
    asked = {url.partition("#")[0] for url in requested(chrome) if not url.startswith("data:")}
    assert asked <= {opened.as_uri(), "about:blank"}


def ask(browser, words):
    return browser.execute_script(f"return {words};")


def unpacked(text, *shape):
    return torch.from_numpy(np.frombuffer(base64.b64decode(text), "<f4").copy()).reshape(shape)


# -- the world --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bank():
    return layouts.load("test")[:SETS]


@pytest.fixture(scope="module")
def poses():
    """x, y [px], heading, set of obstacles: anywhere, also in walls; a third on whole tens, where distances tie."""
    random = torch.Generator().manual_seed(17)
    x, y = (torch.rand(POSES, generator=random) * (side + 20) - 10 for side in (800, 600))
    heading = torch.randint(360, (POSES,), generator=random)
    ties = torch.arange(POSES) % 3 == 0
    x, y = (torch.where(ties, 10 * (place / 10).round(), place) for place in (x, y))
    heading = torch.where(ties, 90 * (heading // 90), heading)
    return x, y, heading, torch.arange(POSES) % SETS


def test_2000_poses_are_sensed_as_by_python_within_a_ten_thousandth(chrome, opened, bank, poses):
    x, y, heading, places = poses
    slots, clearance = sense(x, y, heading, bank[places], World())
    rows = torch.stack([x.double(), y.double(), heading.double(), places.double()], 1)
    rows = [[*row[:2], int(row[2]), int(row[3])] for row in rows.tolist()]
    seen, near = chrome.execute_script(SENSED, rows, bank.double().tolist())
    assert (unpacked(seen, POSES, 10, 3) - slots).abs().max() <= CLOSE
    assert (unpacked(near, POSES) - clearance).abs().max() <= CLOSE
    filled = (slots[..., 2] < 1).sum(1)
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
    """Flights of the eight cells, six each, and two that scripts fly: [set, actions]; and the rows of the cells'."""
    flights, rows = [], []
    for cell in CELLS:
        steps = pd.read_parquet(RESULTS / cell / "behaviour.parquet")
        episodes = pd.read_parquet(RESULTS / cell / "evaluation.parquet")
        for mode, seed in (("greedy", 0), ("sampled", 1)):
            watched, flown = (one[(one["mode"] == mode) & (one["seed"] == seed)] for one in (steps, episodes))
            for place in range(3):
                flights.append([place, watched["action"][watched["layout"] == place].tolist()])
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
        flights.append([7, actions])
    return flights, pd.concat(rows, ignore_index=True)


def in_order(observations):
    """Slots [..., 10, 3] in the order of their right components, whatever their distances."""
    slots = observations.unflatten(-1, (10, 3))
    return slots.gather(-2, slots[..., :1].argsort(-2).expand_as(slots))


def test_50_flights_of_committed_actions_are_flown_as_by_python_and_end_as_their_rows_say(chrome, opened, bank):
    flights, rows = committed()
    found = chrome.execute_script(FLOWN, flights, bank.double().tolist())
    assert len(flights) == len(found) == 50
    task, longest = make_task(bank), max(len(actions) for _, actions in flights)
    padded = torch.tensor([actions + [0] * (longest - len(actions)) for _, actions in flights])
    state = task.start(torch.tensor([place for place, _ in flights]), torch.full((50,), 90))
    seen, poses, counts = [task.observe(state)[0]], [], []
    for actions in padded.T:
        state, outcome = task.step(state, actions)
        seen.append(outcome.observation)
        reached = state.x, state.y, state.heading, outcome.clearance, state.reward, outcome.terminated
        poses.append(torch.stack([one.float() for one in reached], -1))
        counts.append(torch.stack([getattr(state, name).double() for name in COUNTS], -1))
    seen, poses, counts = (torch.stack(one, 1) for one in (seen, poses, counts))
    observed = swapped = crashed = 0
    for place, ((_, actions), (mine, sensed, metrics)) in enumerate(zip(flights, found, strict=True)):
        n = len(actions)
        assert (unpacked(mine, n, 6) - poses[place, :n]).abs().max() <= CLOSE
        here, there = unpacked(sensed, n + 1, 30), seen[place, : n + 1]
        other = ((here - there).abs() > CLOSE).any(-1)
        assert torch.allclose(in_order(here[other]), in_order(there[other]), rtol=0, atol=CLOSE)
        observed, swapped = observed + n + 1, swapped + int(other.sum())
        counted = pd.DataFrame(counts[place, n - 1 : n].numpy(), columns=list(COUNTS))
        assert metrics == pytest.approx(per_episode(counted)[list(paper.COLUMNS)].iloc[0].tolist(), abs=CLOSE)
        crashed += bool(poses[place, n - 1, -1])
        if place < len(rows) and rows["terminated"][place] and rows["steps"][place] == n:
            assert metrics == pytest.approx(per_episode(rows)[list(paper.COLUMNS)].iloc[place].tolist(), abs=CLOSE)
            assert poses[place, n - 1, -1]
    assert crashed >= 10
    assert swapped <= observed / 1000, "neighbours at one distance, which PyTorch's square root rounds otherwise"


# -- who flies --------------------------------------------------------------------------------------------------------


def test_policies_choose_as_in_python_in_999_of_1000_poses_and_the_rule_in_all(chrome, opened, bank, poses):
    x, y, heading, places = poses
    seen = sense(x, y, heading, bank[places], World())[0].flatten(1)
    uniforms = torch.rand(2, POSES, generator=torch.Generator().manual_seed(3))
    found = chrome.execute_script(CHOSEN, seen.double().tolist(), uniforms.double().tolist())
    assert [key for key, *_ in found] == [f"{cell.replace('/', '-')}-0" for cell in CELLS]
    for cell, (_, values, greedy, sampled, flown) in zip(CELLS, found, strict=True):
        policy = load_policy(RESULTS / cell, 0, greedy=False)
        expected = policy.values(seen)
        numbers = uniforms[: len(policy.draw((1,)))]
        assert (unpacked(values, 200, 100) - expected[:200]).abs().max() <= CLOSE
        assert flown == [[*both] for both in zip(greedy[:100], sampled[:100], strict=True)]
        assert (torch.tensor(greedy) == expected.argmax(-1)).float().mean() >= 0.999
        acted = policy.choose(expected, numbers)
        assert (torch.tensor(sampled) == acted).float().mean() >= 0.999
        assert (acted != expected.argmax(-1)).float().mean() > 0.01
    rule = "arguments[0].map((one) => reactive(playground.world, Float32Array.from(one)))"
    mine = chrome.execute_script(f"return {rule}", seen.double().tolist())
    assert mine == BASELINES["reactive"](seen).tolist()
    assert len({*mine}) == 2


def test_every_activation_of_the_package_is_pytorchs_within_a_millionth(chrome, opened):
    x = torch.linspace(-8, 8, 161)
    known = {name: ACTIVATIONS[name] for name in KNOWN}
    found = chrome.execute_script(
        "const [x] = arguments; const all = Object.entries(ACTIVATIONS);"
        "return Object.fromEntries(all.map(([name, act]) => [name, x.map((one) => act(one))]));",
        x.double().tolist(),
    )
    assert {*found} == {*known} == {*KNOWN_TO_THE_PAGE}
    for name, act in known.items():
        assert (torch.tensor(found[name]) - act(x)).abs().max() <= 2e-6, name
    normal = torch.nn.functional.layer_norm(x, x.shape)
    assert (
        torch.tensor(ask(chrome, f"[...normalised(Float32Array.from({x.tolist()}))]")).sub(normal).abs().max() <= 1e-5
    )


def test_sets_of_obstacles_leave_the_start_free_and_are_spread_as_pythons(chrome, opened):
    made = "Array.from({ length: 500 }, (_, seed) => generate(playground.world, 8, seed))"
    bank = torch.tensor(ask(chrome, made))
    layouts.validate(bank)  # radii, window, safe zone
    x, y, radius = bank.flatten(0, 1).T
    theirs = layouts.generate(500, 8, 0).flatten(0, 1)
    for mine, other, spread in zip((x, y, radius), theirs.T, (800, 600, 70), strict=True):
        assert abs(mine.mean() - other.mean()) < 0.03 * spread
        assert abs(mine.std() - other.std()) < 0.03 * spread
    assert len({tuple(row) for row in bank.flatten(1).tolist()}) == 500
    assert ask(chrome, "generate(playground.world, 16, 5).slice(0, 8)") == ask(
        chrome, "generate(playground.world, 8, 5)"
    )


# -- links ------------------------------------------------------------------------------------------------------------

SCENE = (
    "set=12&k=2&circles=100_100.5_40~700_500_99.9&pilots=rule~ppo-tanh-0~nobody~you"
    "&focus=4&speed=0.25&greedy=yes&seed=9"
)
BAD = (
    *("set=-1", "set=1e9", "k=99", "k=", "speed=99", "focus=5", "seed=4294967296", "greedy=perhaps", "pilots=rule"),
    *("pilots=you~you~rule~rule", "pilots=rule~rule~rule~<b>", "circles=400_300_50", "circles=100_100_500"),
    *("circles=NaN_1_50", "circles=100_100", "__proto__=1", "constructor=x", "toString", "%3Cscript%3E=1"),
    "<img/src=x/onerror=alert(1)>=1",
)


def test_a_link_restores_its_scene_and_the_same_flights(browser, opened):
    ends = []
    for _ in range(2):
        visit(browser, opened, f"#{SCENE}")
        assert ask(browser, "playground.scene") == {
            "set": 12, "k": 2, "circles": [pytest.approx([100, 100.5, 40]), pytest.approx([700, 500, 99.9])],
            "pilots": ["rule", "ppo-tanh-0", "nobody", "you"], "focus": 4, "speed": 0.25, "greedy": True, "seed": 9,
        }  # fmt: skip
        assert not one(browser, "#notice").is_displayed()
        steps(browser, 50)
        ends.append(ask(browser, "playground.race.drones.map(({ state }) => [state.x, state.y])"))
    assert ends[0] == ends[1]
    assert ask(browser, "writeLink({ ...playground.scene, circles: playground.race.circles })") == SCENE
    one(browser, "#next").click()
    assert "set=13&k=2&pilots=rule~ppo-tanh-0~nobody~you&focus=4" in browser.current_url


def test_a_bad_part_of_a_link_is_named_as_text_and_the_rest_holds(browser):
    first = ask(browser, "playground.first()")
    for bad in BAD:
        browser.execute_script("location.hash = arguments[0]", f"speed=2&{bad}")
        wait(browser, lambda: one(browser, "#notice").is_displayed())
        assert ask(browser, "playground.scene") == {**first, "speed": 2}, bad
        name = ask(browser, "location.hash").partition("&")[2].partition("=")[0][:20]
        assert one(browser, "#notice").text == f"Left out of the link, because it is not right: {name}."
        browser.execute_script("location.hash = ''")
        wait(browser, lambda: not one(browser, "#notice").is_displayed())
    assert find(browser, "#notice *, img, script:not([type]) ~ script") == []


# -- what a visitor does ----------------------------------------------------------------------------------------------


def drone(browser, place=0):
    return ask(browser, f"playground.race.drones[{place}].state")


def steps(browser, n):
    browser.execute_script("for (let n = 1; n < arguments[0]; n += 1) playground.advance(); playground.oneStep()", n)


def touch(browser, kind, *points):
    browser.execute_cdp_cmd(
        "Input.dispatchTouchEvent", {"type": kind, "touchPoints": [{"x": x, "y": y} for x, y in points]}
    )


def on_screen(browser, x, y):
    """Where a point of the world [px] is in the window."""
    box = ask(
        browser,
        "(({ left, top, width }) => [left, top, width])(document.querySelector('#arena').getBoundingClientRect())",
    )
    return box[0] + x * box[2] / 800, box[1] + (600 - y) * box[2] / 800


def test_arrow_keys_fly_drone_1_and_only_where_no_control_has_the_focus(browser):
    press(browser, Keys.ARROW_UP, Keys.ARROW_UP, "w", Keys.ARROW_DOWN)
    steps(browser, 5)
    assert (drone(browser)["x"], drone(browser)["y"]) == (400, 310)
    press(browser, Keys.ARROW_LEFT)  # shorter than a step, and still a turn
    steps(browser, 2)
    assert drone(browser)["heading"] == 95
    webdriver.ActionChains(browser).key_down(Keys.ARROW_RIGHT).perform()
    steps(browser, 2)
    webdriver.ActionChains(browser).key_up(Keys.ARROW_RIGHT).perform()
    steps(browser, 1)
    assert drone(browser)["heading"] == 87
    browser.execute_script("document.querySelector('#speed').focus()")
    press(browser, "w")
    assert ask(browser, "playground.race.hand[1]") == 2


def test_time_goes_stops_steps_and_starts_again_by_keys_alone(browser):
    assert one(browser, "#banner").text == "Press Play, or Space."
    press(browser, Keys.SPACE)
    wait(browser, lambda: drone(browser, 1)["steps"] > 2)
    assert one(browser, "#play").text == "Pause"
    press(browser, Keys.SPACE)
    there = drone(browser, 1)["steps"]
    press(browser, ".")
    assert drone(browser, 1)["steps"] == there + 1
    assert f"2, PPO tanh: flies, step {there + 1}, reward " in one(browser, "#status").get_property("textContent")
    press(browser, "-", "-", "+")
    assert Select(one(browser, "#speed")).first_selected_option.text == "0.5×"
    press(browser, "r")
    assert drone(browser, 1)["steps"] == 0
    circles = ask(browser, "playground.race.circles")
    press(browser, "n")
    assert ask(browser, "playground.race.circles") != circles
    press(browser, "p")
    assert ask(browser, "playground.race.circles") == circles


def test_a_drone_is_handed_over_in_mid_flight_and_taken_back_where_it_is(browser):
    steps(browser, 20)
    press(browser, "3", "t")
    before = drone(browser, 2)
    assert ask(browser, "playground.race.drones.map(({ pilot }) => pilot)") == ["rule", "ppo-tanh-0", "you", "rule"]
    press(browser, Keys.ARROW_UP)
    steps(browser, 1)
    assert drone(browser, 2)["steps"] == before["steps"] + 1
    press(browser, "t")
    assert ask(browser, "playground.race.drones[2].pilot") == "dqn-tanh-0"
    for cell in CELLS:
        there = drone(browser, 2)
        Select(one(browser, "#pilot")).select_by_value(f"{cell.replace('/', '-')}-1")
        assert drone(browser, 2) == there
        assert cell.split("/")[1].replace("_", " ") in one(browser, ".seat-3 small").text
        steps(browser, 1)
        hidden = ask(browser, "playground.race.drones[2].thought.hidden.map((units) => units.length)")
        assert hidden == [64, 64]


def test_the_table_holds_the_six_metrics_of_each_drone(browser):
    steps(browser, 60)
    names = [row.get_attribute("data-metric") for row in find(browser, "[data-metric]")]
    assert names == list(paper.COLUMNS)
    for place in range(4):
        state = pd.DataFrame({name: [number] for name, number in drone(browser, place).items() if name in COUNTS})
        expected = per_episode(state).iloc[0]
        for name in names:
            shown = find(browser, f"[data-metric={name}] td")[place].text.replace("−", "-")
            assert float(shown) == pytest.approx(expected[name], abs=0.51 if METRICS[name].scale != 1 else 0.051)


def test_obstacles_are_drawn_moved_sized_and_deleted_by_a_finger_and_by_keys(browser):
    resize(browser, NARROW)
    one(browser, "#draw").click()
    one(browser, "#clear").click()
    browser.execute_script("scrollTo(0, 0)")
    start, edge = on_screen(browser, 100, 450), on_screen(browser, 160, 450)
    touch(browser, "touchStart", start)
    touch(browser, "touchMove", edge)
    touch(browser, "touchEnd")
    (circle,) = ask(browser, "playground.race.circles")
    assert circle == pytest.approx([100, 450, 60], abs=3)
    assert "circles=" in browser.current_url
    touch(browser, "touchStart", start)
    touch(browser, "touchMove", on_screen(browser, 400, 300))
    touch(browser, "touchEnd")
    (moved,) = ask(browser, "playground.race.circles")
    assert moved[2] == circle[2]
    assert np.hypot(moved[0] - 400, moved[1] - 300) - moved[2] >= 50  # the start stays free
    press(browser, Keys.ARROW_LEFT, Keys.ARROW_DOWN, "-", "o")
    assert len(ask(browser, "playground.race.circles")) == 2
    nudged = ask(browser, "playground.race.circles[0]")
    assert nudged[2] == pytest.approx(moved[2] - 5, abs=0.06)
    press(browser, Keys.DELETE, Keys.DELETE, "e")
    assert ask(browser, "playground.race.circles") == []
    assert not one(browser, "#drawing").is_displayed()


def test_a_finger_steers_and_the_density_is_a_slider(browser):
    resize(browser, NARROW)
    browser.execute_script("scrollTo(0, 0)")
    touch(browser, "touchStart", on_screen(browser, 600, 300))
    steps(browser, 25)
    assert 400 < drone(browser)["x"] <= 600
    assert drone(browser)["heading"] == pytest.approx(0, abs=20) or drone(browser)["heading"] > 330
    touch(browser, "touchEnd")
    there = drone(browser)["distance"]
    steps(browser, 2)
    assert drone(browser)["distance"] == there
    browser.execute_script("const k = document.querySelector('#k'); k.value = 13; k.dispatchEvent(new Event('input'))")
    assert len(ask(browser, "playground.race.circles")) == 13
    assert one(browser, "#k-now").text == "13"


def test_a_crash_is_told_and_when_all_are_down_the_race_is_over(browser, opened):
    visit(browser, opened, "#pilots=you~nobody~nobody~nobody")
    press(browser, *([Keys.ARROW_UP] * 9), Keys.SPACE)
    wait(browser, lambda: one(browser, "#banner").is_displayed(), 20)
    assert one(browser, "#banner").text.startswith("All are down.")
    assert "1, You keys: crashed, step " in one(browser, "#status").get_property("textContent")
    assert drone(browser)["reward"] == pytest.approx(0.09 * (drone(browser)["steps"] - 1) - 10, abs=0.5)


def test_it_plays_by_itself_but_not_for_those_who_want_less_motion(browser, opened):
    assert drone(browser, 1)["steps"] == 0
    assert not ask(browser, "playground.playing")
    visit(browser, opened, motion="no-preference")
    wait(browser, lambda: drone(browser, 1)["steps"] > 3)


# -- how it looks -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("width", "colours"), [(WIDE, "light"), (NARROW, "dark")])
def test_axe_finds_nothing_and_all_text_is_readable_and_within_the_screen(browser, opened, width, colours):
    visit(browser, opened, width=width, colours=colours)
    browser.execute_script("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    one(browser, "#draw").click()
    browser.execute_script("arguments[0].length; (0, eval)(arguments[0])", AXE.read_text())
    found = browser.execute_async_script(
        "axe.run(document, {}).then((found) => arguments[arguments.length - 1](found.violations))"
    )
    assert [(rule["id"], [node["html"] for node in rule["nodes"]]) for rule in found] == []
    assert {name: ratio for name, ratio in browser.execute_script(PAIRS).items() if ratio < 4.5} == {}
    assert browser.execute_script(FONTS) == []
    assert ask(browser, "document.documentElement.scrollWidth") <= width
    for control in find(browser, "button, select, input"):
        if control.is_displayed():
            assert control.rect["x"] + control.rect["width"] <= width
            assert control.rect["height"] >= 18


def test_tab_reaches_the_arena_and_every_control_with_an_outline(browser):
    reached = []
    for _ in range(40):
        press(browser, Keys.TAB)
        name, style, width = browser.execute_script(
            "const one = document.activeElement, style = getComputedStyle(one);"
            "const name = one === document.body ? '' : one.id || one.className || one.textContent;"
            "return [name, style.outlineStyle, parseFloat(style.outlineWidth)]"
        )
        if name in reached or not name:
            break
        assert (style, width >= 2) == ("solid", True), name
        reached.append(name)
    controls = [
        one.get_attribute("id") for one in find(browser, "button[id], select[id], input[id]") if one.is_displayed()
    ]
    assert {"stage", *controls} <= {*reached}
    assert reached[0] == "stage"


def test_one_file_below_3_mb_holds_three_seeds_of_each_cell_and_what_it_is(opened):
    assert opened.stat().st_size < 3e6
    text = opened.read_text()
    assert [one["key"] for one in json.loads(text.split('id="data">')[1].split("</script>")[0])["policies"]] == [
        f"{cell.replace('/', '-')}-{seed}" for cell in CELLS for seed in (0, 1, 2)
    ]
