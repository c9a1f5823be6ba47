"""The playground's other worlds in a real browser: faults, rules, sets of obstacles, links, and who can fly where."""

import numpy as np
import pytest
import torch
from browsing import ask, complaints, find, forget, one, visit, wait
from selenium.webdriver.support.ui import Select
from test_playground import CLOSE, FLOWN, in_order, in_python, sets_of, unpacked
from test_replays import write_run

from uavnav.tasks import goal, slalom
from uavnav.tasks.baselines import dodge, towards_goal
from uavnav.tasks.simulator import make_task
from uavnav.views.browser.playground import SETTINGS, WORLDS, collect, page

pytestmark = pytest.mark.slow

FAULTS = {"noise": 5.0, "lost": 0.2, "late": 2, "sticky": 0.25}


# -- held to Python ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["drone", "moving", "goal"])
def test_with_the_same_random_numbers_faults_do_what_they_do_in_python(chrome, opened, name):
    task = make_task("test", task=name, faults=FAULTS)
    task, random = task.with_bank(task.bank[:20]), torch.Generator().manual_seed(5)
    actions = torch.randint(100, (20, 60), generator=random)
    draws = task.draw(20 * 61, random).unflatten(0, (20, 61))
    seen, poses, _, ends = in_python(task, torch.arange(20), actions, draws)
    last = torch.where(ends.any(1), ends.int().argmax(1) + 1, 60).tolist()
    flights = [[n, actions[n, :end].tolist(), draws[n].double().tolist()] for n, end in enumerate(last)]
    found = chrome.execute_script(FLOWN, name, flights, sets_of(task), FAULTS)
    for n, (end, (mine, sensed, _)) in enumerate(zip(last, found, strict=True)):
        assert (unpacked(mine, end, 8) - poses[n, :end]).abs().max() <= CLOSE
        here, there = unpacked(sensed, end + 1, seen.shape[-1]), seen[n, : end + 1]
        assert torch.allclose(in_order(here), in_order(there), rtol=0, atol=CLOSE)
    assert sum(last) > 500
    without = in_python(make_task(task.bank, task=name), torch.arange(20), actions)[0]
    differ = (without[:, :20] - seen[:, :20]).abs().amax((1, 2)) > 0.01
    assert differ.sum() >= 15  # negative control: without faults other things are seen


@pytest.mark.parametrize(("rule", "expected"), [("moving", dodge), ("goal", towards_goal)])
def test_the_rules_of_other_worlds_choose_as_in_python_in_999_of_1000_poses(chrome, opened, rule, expected):
    task, random = make_task("test", task=rule), torch.Generator().manual_seed(2)
    x, y = (torch.rand(2000, generator=random) * (side - 100) + 50 for side in (800, 600))
    heading, steps = (torch.randint(n, (2000,), generator=random) for n in (360, 1000))
    state = task.place(torch.arange(2000) % 1000, heading)._replace(x=x, y=y, steps=steps)
    seen = task.observe(state)[0]
    words = "const [name, seen] = arguments, { world, rules } = playground.data.tasks[name];"
    words += "return seen.map((one) => RULES[name](world, Float32Array.from(one), rules));"
    mine = torch.tensor(chrome.execute_script(words, rule, seen.double().tolist()))
    assert (mine == expected(seen)).float().mean() >= 0.999
    assert len(mine.unique()) >= 10


# -- sets of obstacles ------------------------------------------------------------------------------------------------


def made(browser, world, n, **scene):
    """The sets 0 to n - 1 of a world."""
    words = "const [name, n, scene] = arguments; const task = new TASKS[name](playground.data.tasks[name]);"
    words += "return Array.from({ length: n }, (_, set) => task.generate({ ...scene, set }));"
    return browser.execute_script(words, world, n, scene)


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


def test_obstacles_that_move_are_those_of_the_papers_world_with_uniform_speeds_in_all_directions(chrome, opened):
    standing, moving = made(chrome, "drone", 200, k=8), made(chrome, "moving", 200, k=8)
    circles = np.array([one["circles"] for one in moving])
    assert np.array_equal(circles[..., :3], [one["circles"] for one in standing])
    speed = np.hypot(circles[..., 3], circles[..., 4]).ravel()
    assert speed.max() <= 2
    assert (speed.mean(), speed.std()) == (pytest.approx(1, abs=0.05), pytest.approx(2 / np.sqrt(12), abs=0.03))
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


# -- what a visitor does ----------------------------------------------------------------------------------------------


@pytest.fixture
def browser(chrome, opened):
    forget(chrome)
    visit(chrome, opened)
    yield chrome
    assert complaints(chrome) == []


def go(browser, steps):
    words = "for (let n = 1; n < arguments[0]; n += 1) playground.advance(); playground.oneStep()"
    browser.execute_script(words, steps)


def slide(browser, name, value):
    words = "const one = document.getElementById(arguments[0]); one.value = arguments[1];"
    browser.execute_script(f"{words} one.dispatchEvent(new Event('input'))", name, value)


def states(browser):
    return [cell.text for cell in find(browser, ".state td")]


def test_each_world_shows_its_own_sliders_and_says_who_flies(browser):
    choice = Select(one(browser, "#world"))
    assert [option.text for option in choice.options] == [world["title"] for world in WORLDS.values()]
    shown = {"drone": {"k"}, "slalom": {"gap"}, "moving": {"k", "pace"}, "goal": {"k"}}
    for name, sliders in shown.items():
        choice.select_by_value(name)
        assert {s for s in ("k", "gap", "pace") if one(browser, f"#{s}").is_displayed()} == sliders
        go(browser, 1)
        assert states(browser) == ["flying", *(["cannot fly"] * 2 if name == "goal" else ["flying"] * 2), "flying"]
        assert one(browser, "#told").text.startswith(WORLDS[name]["told"])
    assert one(browser, "#told").text.endswith("No network here has learned that: you and the rule fly.")
    assert ask(browser, "playground.scene.focus") == 1  # a drone that can fly
    options = Select(one(browser, "#pilot")).options
    assert {option.text for option in options if option.is_enabled()} == {"you", "the rule", "nobody"}
    choice.select_by_value("drone")
    assert ask(browser, "playground.race.flying().length") == 4


def test_the_rule_reaches_its_goal_and_the_page_says_so(browser, opened):
    visit(browser, opened, "#world=goal&pilots=nobody~nobody~nobody~rule&focus=4")
    go(browser, 1000)
    assert states(browser)[3] == "arrived"
    assert one(browser, "#banner").text.startswith("The race is over.")
    assert "4, Rule scripted: arrived" in one(browser, "#status").get_property("textContent")
    assert one(browser, "#sensor").get_attribute("aria-label").endswith(" px")
    visit(browser, opened, "#world=goal&pilots=you~nobody~nobody~nobody")
    go(browser, 1000)
    assert states(browser)[0] == "too late"


def test_networks_trained_with_faults_say_so(tmp_path):
    write_run(tmp_path / "plain", n_seeds=1)
    write_run(tmp_path / "faulty", n_seeds=1, faults={"noise": 5.0, "late": 2})
    faulty, plain = sorted(collect([tmp_path])[0], key=lambda one: "noise" not in one["title"])
    assert "seed 0 with noise=5, late=2 (" in faulty["title"]
    assert faulty["told"].startswith("100 frames of training with noise=5, late=2; ")
    assert " with " not in plain["title"] + plain["told"]


def test_a_page_of_networks_trained_for_goals_begins_there_and_they_fly_there_alone(chrome, tmp_path):
    write_run(tmp_path / "ppo" / "tanh", task="goal", n_seeds=1, n_inputs=33, prefer=[(0, 9)])
    path = tmp_path / "playground.html"
    path.write_text(page(collect([tmp_path])[0]))
    visit(chrome, path)
    assert ask(chrome, "playground.scene.world") == "goal"
    go(chrome, 1)
    assert states(chrome) == ["flying", "flying", "", "flying"]
    assert ask(chrome, "playground.race.drones[1].state.y") == 309  # nine pixels up, as it learned
    assert "No network" not in one(chrome, "#told").text
    Select(one(chrome, "#world")).select_by_value("drone")
    go(chrome, 1)
    assert states(chrome) == ["flying", "cannot fly", "", "flying"]
    link = ask(chrome, "writeLink(playground.scene, playground.data.settings)")
    visit(chrome, path, f"#{link}")
    assert ask(chrome, "playground.scene.world") == "drone"


def test_obstacles_move_as_time_goes_and_stand_still_where_they_start_while_one_draws(browser, opened):
    visit(browser, opened, "#world=moving&pace=4&pilots=you~nobody~nobody~nobody&focus=1")
    first = ask(browser, "playground.race.obstaclesAt(1)")
    go(browser, 20)
    later = ask(browser, "playground.race.obstaclesAt(1)")
    assert ask(browser, "playground.race.task.obstacles(playground.race.set, 20)") == later
    assert sum(a != b for a, b in zip(first, later, strict=True)) >= 7
    assert ask(browser, "playground.race.obstaclesAt(0.5)") != later
    one(browser, "#draw").click()
    assert ask(browser, "playground.race.steps") == 0
    one(browser, "#add").click()
    assert len(ask(browser, "playground.race.circles")) == 9
    one(browser, "#play").click()
    assert not ask(browser, "playground.stage.drawing")
    wait(browser, lambda: ask(browser, "playground.race.steps") > 1)
    one(browser, "#play").click()
    drawn = ask(browser, "playground.race.set")
    wait(browser, lambda: "circles=" in browser.current_url)
    visit(browser, opened, f"#{browser.current_url.partition('#')[2]}")
    for mine, other in zip(ask(browser, "playground.race.set.circles"), drawn["circles"], strict=True):
        assert mine == pytest.approx(other, abs=0.06)


def test_a_drone_that_nobody_flew_senses_obstacles_where_they_are_once_it_is_handed_over(browser, opened):
    visit(browser, opened, "#world=moving&pace=4&pilots=rule~nobody~nobody~nobody&set=3")
    go(browser, 25)
    browser.execute_script("playground.handTo(1, 'rule')")
    expected = "playground.race.task.obstacles(playground.race.set, playground.race.steps)"
    near = f"Math.min(...{expected}.map(([x, y, r]) => Math.hypot(x - 400, y - 300) - r), 270)"  # px, at the start
    waited, clearance = ask(browser, "(({ state, clearance }) => [state, clearance])(playground.race.drones[1])")
    assert (waited["steps"], waited["waited"], waited["x"], waited["y"]) == (0, 25, 400, 300)
    assert clearance == pytest.approx(ask(browser, near), abs=1e-3)
    assert clearance != pytest.approx(ask(browser, near.replace("playground.race.steps", "0")), abs=1)
    go(browser, 1)
    assert ask(browser, "playground.race.drones.map(({ state }) => state.steps)") == [26, 1, 0, 0]


def test_an_edited_obstacle_leaves_what_sticks_as_it_is(browser, opened):
    visit(browser, opened, "#sticky=0.5&pilots=rule~nobody~nobody~nobody")
    go(browser, 3)
    before = ask(browser, "playground.race.drones[0].state.executed")
    browser.execute_script("playground.edit([])")
    assert ask(browser, "playground.race.drones[0].state.executed") == before == 9


def test_a_circle_stays_off_the_goal_in_a_drawing_and_in_a_link(browser, opened):
    visit(browser, opened, "#world=goal&set=5")
    assert ask(browser, "playground.focus") == 0  # the first that can fly
    goal_x, goal_y = ask(browser, "playground.race.set.goal")
    for at in ((goal_x, goal_y), (goal_x + 30, goal_y), (400, 300), (0, 0), (800, 600)):
        placed = "allowed(playground.world, [...arguments, 100], playground.race.free)"
        x, y, radius = browser.execute_script(f"return {placed}", *at)
        assert np.hypot(x - goal_x, y - goal_y) - radius >= goal.ROOM
        assert np.hypot(x - 400, y - 300) - radius >= 50
        assert 0 <= x <= 800
        assert 0 <= y <= 600
    for at, words in ((f"{goal_x:.1f}_{goal_y:.1f}", "circles"), (f"{x:.1f}_{y:.1f}", "")):
        visit(browser, opened, f"#world=goal&set=5&circles={at}_100")
        assert one(browser, "#notice").text.endswith(f": {words}." if words else "")
        assert bool(ask(browser, "playground.scene.circles")) != bool(words)


def test_faults_are_sliders_in_a_link_and_change_the_flights(browser, opened):
    ends = []
    for value in (0, 0.5, 0):
        slide(browser, "sticky", value)
        go(browser, 40)
        ends.append(ask(browser, "playground.race.drones.map(({ state }) => [state.x, state.y])"))
    assert ends[0] == ends[2] != ends[1]
    for name, value in (("noise", 5), ("lost", 0.1), ("late", 2)):
        slide(browser, name, value)
    assert one(browser, "#faults-now").text == "noise 5, lost 0.1, late 2"
    wait(browser, lambda: "#noise=5&lost=0.1&late=2&set=" in browser.current_url)
    go(browser, 5)
    assert ask(browser, "playground.race.drones[1].state.seen.length") == 3


def test_a_link_restores_another_world_with_its_settings(browser, opened):
    scenes = (
        "world=slalom&gap=90&sticky=0.25&set=4&k=8",
        "world=moving&pace=5.5&set=1&k=3",
        "world=goal&noise=2&set=9&k=12",
    )
    for scene in scenes:
        link = f"{scene}&pilots=you~ppo-relu-1~nobody~rule&focus=4&speed=2&greedy=no&seed=7"
        visit(browser, opened, f"#{link}")
        assert not one(browser, "#notice").is_displayed()
        found = ask(browser, "playground.scene")
        for part in scene.split("&"):
            name, _, value = part.partition("=")
            assert str(found[name]) == value
        assert ask(browser, "writeLink(playground.scene, playground.data.settings)") == link
    assert {*SETTINGS} <= {*found}
