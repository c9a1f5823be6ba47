"""The playground in a real browser: links, keys, fingers and looks, and that nothing comes from elsewhere."""

import json
import time
from urllib.parse import unquote

import numpy as np
import pandas as pd
import pytest
from browsing import (
    CONFIGURATIONS,
    FONTS,
    NARROW,
    PAIRS,
    WIDE,
    ask,
    complaints,
    find,
    forget,
    one,
    press,
    requested,
    resize,
    violations,
    visit,
    wait,
)
from runs_by_hand import write_policies
from selenium import webdriver
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select

from uavnav.__main__ import main
from uavnav.cli import play
from uavnav.colours import colours
from uavnav.report import frames
from uavnav.runs import paper
from uavnav.runs.metrics import METRICS, per_episode
from uavnav.tasks import goal, layouts
from uavnav.tasks.state import COUNTS
from uavnav.tasks.table import make_task
from uavnav.views.browser.playground import ABOUT, SCRIPTED, SETTINGS, Opening, collect, page

pytestmark = pytest.mark.slow


@pytest.fixture
def browser(chrome, opened):
    """The page as a visitor without a link gets it; it makes no request and no complaint."""
    forget(chrome)
    visit(chrome, opened)
    yield chrome
    assert complaints(chrome) == []
    asked = {url.partition("#")[0] for url in requested(chrome) if not url.startswith("data:")}
    assert asked <= {opened.as_uri(), "about:blank"}


def follow(browser, fragment):
    """What a link to another scene of the open page does."""
    browser.execute_script(
        """return new Promise((done) => {
          addEventListener("hashchange", () => done(), { once: true });
          location.hash = arguments[0];
        })""",
        fragment,
    )


# -- links ---------------------------------------------------------------------------------------------------

SCENE = (
    "task=drone&layouts=test&layout=12&circles=100_100.5_40~700_500_99.9&pilots=reactive~ppo-tanh-0~nobody~you"
    "&focus=4&speed=0.25&greedy=yes&seed=9"
)
WRITTEN = "writeLink({ ...playground.scene, circles: playground.race.circles }, playground.data.settings)"
BAD = (
    *("task=mars", "task=toString", "gap=65", "gap=121", "pace=2.25", "noise=21", "late=1.5", "lost=-1"),
    "sticky=<b>",
    *(
        "layout=-1",
        "layout=1e9",
        "layouts=mars",
        "k=99",
        "k=",
        "speed=99",
        "focus=5",
        "seed=4294967296",
        "greedy=perhaps",
        "greedy=constructor",
        "pilots=reactive",
    ),
    *(
        "pilots=you~you~reactive~reactive",
        "pilots=reactive~reactive~reactive~<b>",
        "circles=400_300_50",
        "circles=100_100_500",
    ),
    *("circles=NaN_1_50", "circles=100_100", "__proto__=1", "constructor=x", "toString", "%3Cscript%3E=1"),
    "<img/src=x/onerror=alert(1)>=1",
)


def test_a_link_restores_its_scene_and_the_same_episodes(browser, opened):
    ends = []
    for _ in range(2):
        visit(browser, opened, f"#{SCENE}")
        assert ask(browser, "playground.scene") == {
            **{name: one.first for name, one in SETTINGS.items()},
            "task": "drone", "layouts": "test", "layout": 12, "k": 8,
            "circles": [pytest.approx([100, 100.5, 40]), pytest.approx([700, 500, 99.9])],
            "pilots": ["reactive", "ppo-tanh-0", "nobody", "you"], "focus": 4,
            "speed": 0.25, "greedy": True, "seed": 9,
        }  # fmt: skip
        assert not one(browser, "#notice").is_displayed()
        steps(browser, 50)
        ends.append(ask(browser, "playground.race.drones.map(({ state }) => [state.x, state.y])"))
    assert ends[0] == ends[1]
    assert ask(browser, WRITTEN) == SCENE
    one(browser, "#next").click()
    wait(
        browser,
        lambda: "layouts=test&layout=13&pilots=reactive~ppo-tanh-0~nobody~you&focus=4" in browser.current_url,
    )


def test_a_bad_part_of_a_link_is_named_as_text_and_the_rest_holds(browser):
    first = ask(browser, "playground.data.scene")
    for bad in BAD:
        browser.execute_script("location.hash = arguments[0]", f"speed=2&{bad}")
        wait(browser, lambda: one(browser, "#notice").is_displayed())
        assert ask(browser, "playground.scene") == {**first, "speed": 2}, bad
        name = unquote(ask(browser, "location.hash").partition("&")[2].partition("=")[0])[:20]
        assert one(browser, "#notice").text == f"Left out of the link, because it is not right: {name}."
        browser.execute_script("location.hash = ''")
        wait(browser, lambda: not one(browser, "#notice").is_displayed())
    assert find(browser, "#notice *, img, script:not([type]) ~ script") == []


@pytest.mark.parametrize(
    ("fragment", "left_out"),
    [
        ("task=slalom&layouts=test&layout=5", "layouts"),
        ("layouts=test&layout=205", "layout"),
        ("task=moving&layouts=test&pace=6", "pace"),
        ("task=slalom", ""),
        ("task=moving&layouts=random&pace=6&layout=205", ""),
    ],
)
def test_what_a_link_says_and_its_task_or_its_layouts_do_not_have_is_named(
    fragment, left_out, browser, opened
):
    visit(browser, opened, f"#{fragment}")
    told = one(browser, "#notice").text
    assert told == (left_out and f"Left out of the link, because it is not right: {left_out}.")


# -- what a visitor does -------------------------------------------------------------------------------------


def drone(browser, place=0):
    return ask(browser, f"playground.race.drones[{place}].state")


def steps(browser, n):
    browser.execute_script(
        "for (let n = 1; n < arguments[0]; n += 1) playground.advance(); playground.oneStep()", n
    )


def touch(browser, kind, *points):
    browser.execute_cdp_cmd(
        "Input.dispatchTouchEvent", {"type": kind, "touchPoints": [{"x": x, "y": y} for x, y in points]}
    )


def on_screen(browser, x, y):
    """Where a point of the world [px] is in the window."""
    box = ask(
        browser,
        "(({ left, top, width }) => [left, top, "
        "width])(document.querySelector('#arena').getBoundingClientRect())",
    )
    return box[0] + x * box[2] / 800, box[1] + (600 - y) * box[2] / 800


def test_arrow_keys_fly_drone_1_and_only_where_no_list_or_field_has_the_focus(browser):
    press(browser, ".")  # one step, in which drone 1 waits
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


def test_the_first_arrow_key_starts_and_space_lets_one_watch_while_drone_1_waits(browser, opened):
    assert one(browser, "#banner-words").text == "Press an arrow key to fly, Space to watch."
    time.sleep(0.3)
    assert drone(browser, 1)["steps"] == 0
    press(browser, Keys.ARROW_UP)
    wait(browser, lambda: drone(browser)["y"] > 302)
    assert not one(browser, "#banner").is_displayed()
    assert ask(browser, "[playground.scene.focus, playground.playing]") == [1, True]
    visit(browser, opened)
    press(browser, Keys.SPACE)
    wait(browser, lambda: drone(browser, 1)["steps"] > 5)
    assert ask(browser, "playground.scene.focus") == 2
    assert states(browser) == ["waiting", "flying", "flying", "flying"]
    assert (drone(browser)["steps"], drone(browser)["waited"] > 3) == (0, True)
    press(browser, "2", Keys.ARROW_LEFT)  # it takes off, and is in focus
    wait(browser, lambda: drone(browser)["steps"] > 1)
    assert ask(browser, "playground.scene.focus") == 1


def test_time_stops_steps_and_starts_again_by_keys_alone(browser):
    press(browser, Keys.SPACE)
    wait(browser, lambda: drone(browser, 1)["steps"] > 2)
    assert one(browser, "#play").text == "Pause"
    press(browser, Keys.SPACE)
    there = drone(browser, 1)["steps"]
    press(browser, ".")
    assert drone(browser, 1)["steps"] == there + 1
    told = one(browser, "#status").get_property("textContent")
    assert f"2, PPO tanh: flies, step {there + 1}, reward " in told
    assert told.startswith("1, You keys: waits, step 0, ")
    press(browser, "-", "-", "+")
    assert Select(one(browser, "#speed")).first_selected_option.text == "0.5×"
    press(browser, "r")
    assert drone(browser, 1)["steps"] == 0
    circles = ask(browser, "playground.race.circles")
    press(browser, "n")
    assert ask(browser, "playground.race.circles") != circles
    press(browser, "p")
    assert ask(browser, "playground.race.circles") == circles


def test_a_seed_repeats_the_random_choices_and_another_makes_others(browser):
    ends = []
    for seed in (0, 5, 0):
        one(browser, "#seed").send_keys(Keys.CONTROL, "a", Keys.NULL, str(seed), Keys.TAB)
        assert drone(browser, 1)["steps"] == 0
        steps(browser, 60)
        ends.append([drone(browser, place) for place in (1, 3)])
    assert ends[0] == ends[2]
    assert ends[0][0] != ends[1][0]  # PPO samples
    assert ends[0][1] == ends[1][1]  # the rule does not
    one(browser, "#seed").send_keys(Keys.CONTROL, "a", Keys.NULL, "-1", Keys.TAB)
    assert one(browser, "#seed").get_property("value") == "0"


def test_a_drone_is_handed_over_in_mid_episode_and_taken_back_where_it_is(browser):
    steps(browser, 20)
    press(browser, "3", "t")
    assert states(browser) == ["flying"] * 4  # drone 1 waited, and is flown by the scripted policy now
    before = drone(browser, 2)
    assert ask(browser, "playground.race.drones.map(({ pilot }) => pilot)") == [
        "reactive",
        "ppo-tanh-0",
        "you",
        "reactive",
    ]
    press(browser, Keys.ARROW_UP)
    steps(browser, 1)
    assert drone(browser, 2)["steps"] == before["steps"] + 1
    press(browser, "r", "t")  # also after the race began again
    assert ask(browser, "playground.race.drones[2].pilot") == "dqn-tanh-0"
    for configuration in CONFIGURATIONS:
        there = drone(browser, 2)
        Select(one(browser, "#pilot")).select_by_value(f"{configuration.replace('/', '-')}-1")
        assert drone(browser, 2) == there
        assert configuration.split("/")[1].replace("_", " ") in one(browser, ".seat-3 small").text
        steps(browser, 1)
        hidden = ask(browser, "playground.race.drones[2].thought.hidden.map((units) => units.length)")
        assert hidden == [64, 64]


def test_the_table_holds_the_six_metrics_of_each_drone(browser):
    browser.execute_script("playground.race.begin()")
    steps(browser, 60)
    names = [row.get_attribute("data-metric") for row in find(browser, "[data-metric]")]
    assert names == list(paper.COLUMNS)
    for place in range(4):
        state = pd.DataFrame(
            {name: [number] for name, number in drone(browser, place).items() if name in COUNTS}
        )
        expected = per_episode(state).iloc[0]
        for name in names:
            shown = find(browser, f"[data-metric={name}] td")[place].text.replace("−", "-")
            assert float(shown) == pytest.approx(
                expected[name], abs=0.51 if METRICS[name].scale != 1 else 0.051
            )


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
    wait(browser, lambda: "circles=" in browser.current_url)
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
    browser.execute_script(
        "const k = document.querySelector('#k'); k.value = 13; k.dispatchEvent(new Event('input'))"
    )
    assert len(ask(browser, "playground.race.circles")) == 13
    assert one(browser, "#k-now").text == "13"


def test_a_crash_is_told_with_what_one_can_do_next_while_the_others_fly_on(browser, opened):
    press(browser, *([Keys.ARROW_UP] * 9))
    browser.execute_script("for (let n = 0; n < 60; n += 1) playground.advance()")  # as time does
    assert one(browser, "#banner-again").is_displayed()
    crashed = drone(browser)
    assert one(browser, "#banner-words").text.startswith(f"You crashed: step {crashed['steps']}, reward −")
    assert "1, You keys: crashed, step " in one(browser, "#status").get_property("textContent")
    assert crashed["reward"] == pytest.approx(0.01 * (crashed["distance"] - 9) - 10)  # of its last step
    assert drone(browser, 3)["steps"] > crashed["steps"] + 2
    one(browser, "#banner-next").click()
    assert ask(browser, "[playground.scene.layout, playground.race.steps, playground.playing]") == [
        4,
        0,
        False,
    ]
    press(browser, *([Keys.ARROW_UP] * 9))
    steps(browser, 60)
    assert one(browser, "#banner-again").is_displayed()
    press(browser, Keys.ENTER)
    assert ask(browser, "[playground.scene.layout, playground.race.steps]") == [4, 0]
    assert one(browser, "#banner-words").text.startswith("Press an arrow key")
    visit(browser, opened, "#pilots=straight~straight~nobody~nobody")
    steps(browser, 100)
    assert one(browser, "#banner-words").text == "All have crashed."


def test_a_crash_stays_with_the_pilot_that_had_it_whoever_has_the_drone_next(browser, opened):
    """A person who crashed takes another drone; a policy's crash is not the person's who takes its drone."""
    visit(browser, opened, "#pilots=you~straight~reactive~nobody")
    press(browser, ".", *([Keys.ARROW_UP] * 9))
    steps(browser, 60)
    assert states(browser)[:3] == ["crashed", "crashed", "flying"]
    names = "document.querySelectorAll('.who')"
    press(browser, "3", "t")
    steps(browser, 5)
    assert ask(browser, f"[...{names}].map((one) => one.textContent)") == ["You", "Scripted", "You", "–"]
    assert states(browser)[:3] == ["crashed", "crashed", "flying"]
    assert not one(browser, "#banner").is_displayed()  # the drone that is flown now has not ended
    press(browser, "2", "t")
    assert ask(browser, f"[...{names}].map((one) => one.textContent)") == ["You", "Scripted", "Scripted", "–"]
    assert one(browser, "#acts").text.startswith(
        "This drone's episode has ended: the next start hands it over."
    )
    press(browser, "r")
    assert ask(browser, "playground.race.drones.map(({ pilot }) => pilot)") == [
        *("reactive", "you", "reactive", "nobody"),
    ]


def test_a_drone_that_nobody_had_can_be_taken_and_handed_back(browser, opened):
    visit(browser, opened, "#pilots=you~ppo-tanh-0~dqn-tanh-0~nobody")
    for pilots in (["reactive", "ppo-tanh-0", "dqn-tanh-0", "you"], ["reactive"]):
        press(browser, "4", "t")
        assert ask(browser, "playground.race.drones.map(({ pilot }) => pilot)")[-len(pilots) :] == pilots
    press(browser, "2", "t", "t")
    assert ask(browser, "playground.race.drones[1].pilot") == "ppo-tanh-0"


def test_who_waits_can_still_fly_once_all_others_have_crashed_and_step_flies_who_is_alone(browser, opened):
    visit(browser, opened, "#pilots=you~straight~straight~nobody")
    steps(browser, 60)
    assert states(browser)[:3] == ["waiting", "crashed", "crashed"]
    press(browser, Keys.ARROW_UP)
    wait(browser, lambda: drone(browser)["steps"] > 1)
    assert not one(browser, "#banner").is_displayed()
    visit(browser, opened, "#pilots=you~nobody~nobody~nobody")
    one(browser, "#one-step").click()
    assert drone(browser)["steps"] == 1


def test_a_key_that_was_tapped_after_a_crash_turns_nobody_in_the_next_race(browser, opened):
    visit(browser, opened, "#pilots=you~nobody~nobody~nobody&layout=0")
    press(browser, *([Keys.ARROW_UP] * 9))
    steps(browser, 60)
    assert one(browser, "#banner-again").is_displayed()
    press(browser, Keys.ARROW_LEFT, "r", Keys.ARROW_UP)
    wait(browser, lambda: drone(browser)["steps"] > 2)
    assert drone(browser)["heading"] == 90


def test_a_key_that_is_held_down_toggles_once_and_steps_again_and_again(browser):
    held = "['keydown', 1, 2, 3].forEach((_, nth) => document.body.dispatchEvent("
    held += "new KeyboardEvent('keydown', { key: arguments[0], repeat: nth > 0, bubbles: true })));"
    browser.execute_script(held, " ")
    assert ask(browser, "playground.playing")
    browser.execute_script(held, " ")
    assert not ask(browser, "playground.playing")
    there = ask(browser, "playground.race.steps")
    browser.execute_script(held, ".")
    assert ask(browser, "playground.race.steps") == there + 4


def test_a_number_that_is_half_typed_stays_when_a_drone_crashes(browser, opened):
    visit(browser, opened, "#pilots=straight~reactive~nobody~nobody")
    one(browser, "#seed").send_keys(Keys.CONTROL, "a", Keys.NULL, "7")
    steps(browser, 60)
    assert states(browser)[:2] == ["crashed", "flying"]
    assert (one(browser, "#seed").get_property("value"), ask(browser, "playground.scene.seed")) == ("7", 0)


def test_a_drag_ends_with_the_circle_that_it_held(browser, opened):
    """Also where a key deletes it, begins again, or ends the drawing: no other circle is moved."""
    other = [650, 450, 40]

    def mouse(kind, *at):
        (x, y), buttons = on_screen(browser, *at), int(kind != "mouseReleased")
        event = {"type": kind, "x": x, "y": y, "button": "left", "buttons": buttons, "clickCount": 1}
        browser.execute_cdp_cmd("Input.dispatchMouseEvent", event)

    for key, left in ((Keys.DELETE, []), ("r", [[160, 160, 40]]), ("e", [[160, 160, 40]])):
        visit(browser, opened)
        one(browser, "#draw").click()
        browser.execute_script("playground.edit([[150, 150, 40], arguments[0]], 0)", other)
        mouse("mousePressed", 150, 150)
        mouse("mouseMoved", 160, 160)
        press(browser, key)
        mouse("mouseMoved", 200, 200)
        mouse("mouseReleased", 200, 200)
        expected = [pytest.approx(circle, abs=1) for circle in [*left, other]]
        assert ask(browser, "playground.race.circles") == expected


def test_a_long_press_and_a_second_finger_leave_circles_as_they_are(browser):
    circle = [150, 450, 60]
    menu = "const event = new PointerEvent('contextmenu', { clientX: arguments[0], clientY: arguments[1],"
    menu += " cancelable: true }); document.querySelector('#arena').dispatchEvent(event);"
    menu += " return event.defaultPrevented;"
    resize(browser, NARROW)
    one(browser, "#draw").click()
    browser.execute_script("playground.edit([arguments[0]], 0); scrollTo(0, 0)", circle)
    within, free = on_screen(browser, 150, 450), on_screen(browser, 600, 150)
    touch(browser, "touchStart", within)
    assert browser.execute_script(menu, *within)  # what a browser does after half a second
    touch(browser, "touchEnd")
    assert ask(browser, "playground.race.circles") == [circle]
    touch(browser, "touchStart", within)
    touch(browser, "touchStart", within, free)
    touch(browser, "touchMove", on_screen(browser, 170, 450), free)
    touch(browser, "touchEnd")
    (moved,) = ask(browser, "playground.race.circles")
    assert moved == pytest.approx([170, 450, 60], abs=3)
    webdriver.ActionChains(browser).context_click(one(browser, "#arena")).perform()  # the start: no circle
    assert len(ask(browser, "playground.race.circles")) == 1
    browser.execute_script("playground.edit([[400, 150, 60]], 0)")
    x, y = on_screen(browser, 400, 150)
    mouse = {"x": x, "y": y, "button": "right", "clickCount": 1}
    for kind in ("mousePressed", "mouseReleased"):
        browser.execute_cdp_cmd("Input.dispatchMouseEvent", {"type": kind, **mouse})
    assert ask(browser, "playground.race.circles") == []


def test_an_added_circle_is_a_new_one_and_where_none_can_be_the_page_says_what_stays_free(browser, opened):
    one(browser, "#draw").click()
    one(browser, "#add").click()
    press(browser, "]")  # the first again
    one(browser, "#remove").click()
    one(browser, "#add").click()
    circles = ask(browser, "playground.race.circles")
    assert len(circles) == len({tuple(circle) for circle in circles}) == 9
    press(browser, "r", "[")
    assert ask(browser, "playground.stage.selected") == 8
    for fragment, words in (("", "the start"), ("#task=goal", "the start and the goal")):
        visit(browser, opened, fragment)
        browser.execute_script("playground.add([400, 300, 50])")
        assert one(browser, "#notice").text == f"Not there: {words} must stay free."


# -- layouts, and what leaves the page -----------------------------------------------------------------------


def test_layouts_are_those_of_the_splits_by_number_and_sliders_draw_others(browser, opened):
    for split, number in (("test", 3), ("test", 199), ("validation", 0), ("train", 20)):
        Select(one(browser, "#layouts")).select_by_value(split)
        one(browser, "#layout").send_keys(Keys.CONTROL, "a", Keys.NULL, str(number), Keys.TAB)
        assert ask(browser, "playground.race.circles") == layouts.load(split)[number].double().tolist()
    press(browser, Keys.ESCAPE, "n")
    assert ask(browser, "playground.scene.layout") == 21
    visit(browser, opened, "#layouts=test&layout=0")
    for key, number in (("p", 199), ("n", 0)):
        press(browser, key)
        assert ask(browser, "playground.scene.layout") == number
    assert one(browser, "#layout").get_attribute("max") == "199"
    for world in ("moving", "goal"):
        visit(browser, opened, f"#task={world}&layouts=test&layout=7")
        rows = make_task("test", task=world).layouts[7].double().tolist()
        found = ask(browser, "playground.race.layout")
        assert found["circles"] == (rows[:-1] if world == "goal" else rows)
        assert found.get("goal") == (rows[-1][:2] if world == "goal" else None)
    slide(browser, "k", 5)
    assert ask(browser, "[playground.scene.layouts, playground.race.circles.length]") == ["random", 5]


def test_random_layouts_of_other_numbers_are_other_layouts_and_of_the_same_number_the_same(browser):
    for task in ABOUT:
        drawn = []
        for number in (4, 5, 4):
            follow(browser, f"#task={task}&layouts=random&layout={number}&k=8")
            drawn.append(ask(browser, "playground.race.layout"))
        assert drawn[0] == drawn[2] != drawn[1], task


@pytest.fixture
def downloads(browser, tmp_path):
    browser.execute_cdp_cmd(
        "Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(tmp_path)}
    )
    return tmp_path


def test_episodes_by_hand_are_kept_and_shown_by_a_report(browser, opened, downloads, monkeypatch, capsys):
    browser.execute_script("localStorage.clear()")
    monkeypatch.chdir(downloads)
    kept = downloads / "human.csv"
    ends = []
    for number in (0, 1):
        visit(browser, opened, f"#layout={number}&pilots=you~nobody~nobody~nobody&focus=1")
        press(browser, Keys.ARROW_UP, *([Keys.ARROW_UP] * 8))
        steps(browser, 60)
        assert one(browser, "#banner-keep").is_displayed()
        ends.append(drone(browser))
        press(browser, "k")
        assert one(browser, "#notice").text.endswith("For a report: uavnav play --keep human.csv")
        wait(browser, kept.exists)
        assert main(["play", "--keep", str(kept), "--person", "2"]) == 0
        kept.unlink()
    assert capsys.readouterr().out.splitlines()[1].startswith(f"{play.ROWS}: 2 episodes, 1 of them new")
    (name, rows), *others = frames.baselines([downloads / "runs"])[0].items()
    assert (name, others, rows["seed"].tolist(), rows["layout"].tolist()) == ("human", [], [2, 2], [0, 1])
    for column in COUNTS:
        assert rows[column].tolist() == pytest.approx([end[column] for end in ends])
    assert rows["terminated"].all()
    assert rows.attrs == {"layouts": "test", "max_steps": 10_000}
    press(browser, "k")
    assert one(browser, "#notice").text.startswith("There is no new episode to keep")


def test_only_whole_episodes_by_hand_on_test_layouts_as_they_are_can_be_kept(browser):
    drone = "{ ...playground.race.drones[0], ended: 'collision' }"
    kept = f"rowOf(playground.race, {drone}, playground.data.limit) !== undefined"
    assert ask(browser, kept)
    alone = "pilots=reactive~you~nobody~nobody"
    for fragment in ("layouts=train", "sticky=0.5", "task=moving", "circles=none", alone):
        follow(browser, f"#{fragment}")
        assert not ask(browser, kept), fragment
    follow(browser, "")
    assert ask(browser, kept)
    press(browser, "1", "t")
    steps(browser, 3)
    press(browser, "t")
    assert not ask(browser, kept)  # another one began it


def test_an_episode_under_another_time_limit_is_not_offered_to_keep(chrome, tmp_path):
    path = tmp_path / "playground.html"
    path.write_text(page(collect(["reactive"]), Opening(max_steps=20)))
    visit(chrome, path, "#pilots=you~nobody~nobody~nobody")
    press(chrome, Keys.ARROW_UP)
    steps(chrome, 20)
    assert states(chrome)[0] == "time limit"
    assert ask(chrome, "playground.rows") == []
    assert not one(chrome, "#banner-keep").is_displayed()


def test_a_rung_of_the_slalom_has_only_the_circles_that_are_there_and_its_link_restores_a_drawing(
    chrome, tmp_path
):
    path = tmp_path / "playground.html"
    path.write_text(page(collect(["reactive"]), Opening("slalom-80/test", 3)))
    visit(chrome, path)
    there = layouts.load("slalom-80/test")[3]
    expected = there[there[:, 0] >= 0].double().tolist()
    assert ask(chrome, "playground.race.circles") == expected
    assert one(chrome, "#k-now").text == str(len(expected)) < "48"
    one(chrome, "#draw").click()
    one(chrome, "#add").click()
    drawn = ask(chrome, "playground.race.circles")
    assert len(drawn) == len(expected) + 1
    wait(chrome, lambda: "circles=" in chrome.current_url)
    visit(chrome, path, f"#{chrome.current_url.partition('#')[2]}")
    assert not one(chrome, "#notice").is_displayed()
    assert ask(chrome, "playground.race.circles") == [pytest.approx(circle, abs=0.06) for circle in drawn]


@pytest.mark.parametrize("world", ["drone", "moving"])
def test_a_saved_layout_is_one_that_every_command_reads(world, browser, opened, downloads):
    visit(browser, opened, f"#task={world}&layout=5")
    one(browser, "#draw").click()
    one(browser, "#add").click()
    drawn = ask(browser, "playground.race.layout.circles")
    press(browser, "b")
    path = downloads / "own.safetensors"
    wait(browser, path.exists)
    (saved,) = make_task(path, task=world).layouts
    assert saved.double().tolist() == drawn
    assert len(saved) == 9
    visit(browser, opened, "#task=goal")
    press(browser, "b")
    assert one(browser, "#notice").text.startswith("Only layouts with obstacles and without a goal")


# -- how it looks --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("width", "colours", "fragment"),
    [(WIDE, "light", "#task=goal&lost=0.1"), (NARROW, "dark", "#task=moving")],
)
def test_axe_finds_nothing_and_all_text_is_readable_and_within_the_screen(
    browser, opened, width, colours, fragment
):
    visit(browser, opened, fragment, width=width, colours=colours)
    browser.execute_script("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    one(browser, "#draw").click()
    assert violations(browser) == []
    assert {name: ratio for name, ratio in browser.execute_script(PAIRS).items() if ratio < 4.5} == {}
    assert browser.execute_script(FONTS) == []
    assert ask(browser, "document.documentElement.scrollWidth") <= width
    for control in find(browser, "button, select, input"):
        if control.is_displayed():
            assert control.rect["x"] + control.rect["width"] <= width
            assert control.rect["height"] >= 18


def test_pictures_have_as_many_pixels_as_their_places_whatever_the_size_of_the_window(browser):
    sizes = "[...document.querySelectorAll('canvas')].map((one) => [one.width, one.clientWidth])"
    for height in (700, 760, 850):  # the instruments are higher than the arena, and so is the page
        resize(browser, WIDE, height)
        wait(browser, lambda: all(mine == place for mine, place in ask(browser, sizes)))


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
        one.get_attribute("id")
        for one in find(browser, "button[id], select[id], input[id]")
        if one.is_displayed()
    ]
    assert {"stage", *controls} <= {*reached}
    assert reached[0] == "stage"


def test_one_file_below_3_mb_holds_three_seeds_of_each_configuration_and_what_it_is(opened):
    assert opened.stat().st_size < 3e6
    text = opened.read_text()
    assert [
        one["key"] for one in json.loads(text.split('id="data">')[1].split("</script>")[0])["policies"]
    ] == [
        f"{configuration.replace('/', '-')}-{seed}" for configuration in CONFIGURATIONS for seed in (0, 1, 2)
    ]


# -- other worlds --------------------------------------------------------------------------------------------


def slide(browser, name, value):
    words = "const one = document.getElementById(arguments[0]); one.value = arguments[1];"
    browser.execute_script(f"{words} one.dispatchEvent(new Event('input'))", name, value)


def states(browser):
    return [cell.text for cell in find(browser, ".state td")]


def test_each_world_shows_its_own_sliders_and_says_who_flies(browser):
    choice = Select(one(browser, "#task"))
    assert [option.text for option in choice.options] == [task["title"] for task in ABOUT.values()]
    shown = {"drone": {"k"}, "slalom": {"gap"}, "moving": {"k", "pace"}, "goal": {"k"}}
    for name, sliders in shown.items():
        choice.select_by_value(name)
        assert {s for s in ("k", "gap", "pace") if one(browser, f"#{s}").is_displayed()} == sliders
        steps(browser, 1)
        assert states(browser) == [
            "waiting",
            *(["cannot fly"] * 2 if name == "goal" else ["flying"] * 2),
            "flying",
        ]
        assert one(browser, "#told").text.startswith(ABOUT[name]["told"])
        assert ask(browser, "playground.scene.layouts") == ("random" if name == "slalom" else "test")
    assert one(browser, "#told").text.endswith(
        "No network here has learned that: you and the scripted policy fly."
    )
    assert ask(browser, "playground.scene.focus") == 1  # a drone that can fly
    options = Select(one(browser, "#pilot")).options
    assert {option.text for option in options if option.is_enabled()} == {"you", "nobody", *SCRIPTED}
    choice.select_by_value("drone")
    assert ask(browser, "playground.race.flying().length") == 3


def test_reactive_reaches_its_goal_and_the_page_says_so(browser, opened):
    visit(browser, opened, "#task=goal&pilots=nobody~nobody~nobody~reactive&focus=4")
    steps(browser, 1000)
    assert states(browser)[3] == "arrived"
    assert one(browser, "#banner-words").text == "The race is over."
    assert "4, Scripted reactive: arrived" in one(browser, "#status").get_property("textContent")
    assert one(browser, "#sensor").get_attribute("aria-label").endswith(" px")
    visit(browser, opened, "#task=goal&pilots=you~nobody~nobody~nobody")
    browser.execute_script("playground.race.begin()")
    steps(browser, 1000)
    assert states(browser)[0] == "time limit"


def test_networks_trained_with_faults_say_so(tmp_path):
    write_policies(tmp_path / "plain", n_seeds=1)
    write_policies(tmp_path / "faulty", n_seeds=1, faults={"noise": 5.0, "late": 2})
    faulty, plain = sorted(collect([tmp_path])[0], key=lambda one: "noise" not in one["title"])
    assert "seed 0 with noise=5, late=2 (" in faulty["title"]
    assert faulty["told"].startswith("100 frames of training with noise=5, late=2; ")
    assert " with " not in plain["title"] + plain["told"]


def test_a_page_of_networks_trained_for_goals_begins_there_and_they_fly_there_alone(chrome, tmp_path):
    write_policies(tmp_path / "ppo" / "tanh", task="goal", n_seeds=1, n_inputs=33, prefer=[(0, 9)])
    path = tmp_path / "playground.html"
    path.write_text(page(collect([tmp_path])))
    visit(chrome, path)
    assert ask(chrome, "playground.scene.task") == "goal"
    steps(chrome, 1)
    assert states(chrome) == ["waiting", "flying", "flying", ""]
    assert ask(chrome, "playground.race.drones[1].state.y") == 309  # nine pixels up, as it learned
    assert "No network" not in one(chrome, "#told").text
    Select(one(chrome, "#task")).select_by_value("drone")
    steps(chrome, 1)
    assert states(chrome) == ["waiting", "cannot fly", "flying", ""]
    link = ask(chrome, "writeLink(playground.scene, playground.data.settings)")
    visit(chrome, path, f"#{link}")
    assert ask(chrome, "playground.scene.task") == "drone"


def test_named_runs_and_zips_fly_when_the_page_opens_in_the_colours_of_the_one_table(chrome, tmp_path):
    for name in ("a", "b"):
        write_policies(tmp_path / name, n_seeds=2, faults={"late": 2})
    write_policies(tmp_path / "c", "dqn", n_seeds=1)
    flyers = collect([tmp_path / "b", "reactive", tmp_path / "a"], seed=1)
    path = tmp_path / "playground.html"
    path.write_text(page(flyers, Opening("validation", 7, greedy=True)))
    visit(chrome, path)
    scene = ask(chrome, "playground.scene")
    assert scene["pilots"] == ["you", flyers.named[0], "reactive", flyers.named[2]]
    assert [key.split("-")[-4:] for key in (scene["pilots"][1], scene["pilots"][3])] == [
        [name, "ppo", "tanh", "1"] for name in "ba"
    ]
    assert (scene["layouts"], scene["layout"], scene["greedy"], scene["late"]) == ("validation", 7, True, 2)
    assert ask(chrome, "playground.pilots") == colours(["you", "ppo", "reactive", "ppo"])
    found = collect([tmp_path / "c", tmp_path])
    assert (len(found.policies), found.named) == (
        5,
        [one["key"] for one in found.policies if "dqn" in one["key"]],
    )


def test_a_page_of_a_run_with_faults_between_and_beyond_a_sliders_steps_writes_a_link_that_it_reads(
    chrome, tmp_path
):
    write_policies(tmp_path / "run", n_seeds=1, faults={"noise": 2.125, "late": 12})
    path = tmp_path / "playground.html"
    path.write_text(page(collect([tmp_path / "run"])))
    visit(chrome, path)
    link = ask(chrome, "writeLink(playground.scene, playground.data.settings)")
    assert "&noise=2.125&late=12&" in link
    visit(chrome, path, f"#{link}")
    assert not one(chrome, "#notice").is_displayed()
    assert ask(chrome, "[playground.scene.noise, playground.scene.late]") == [2.125, 12]


def test_obstacles_move_as_time_goes_and_stand_still_where_they_start_while_one_draws(browser, opened):
    visit(browser, opened, "#task=moving&pace=4&pilots=you~nobody~nobody~nobody&focus=1")
    browser.execute_script("playground.race.begin()")
    first = ask(browser, "playground.race.obstaclesAt(1)")
    steps(browser, 20)
    later = ask(browser, "playground.race.obstaclesAt(1)")
    assert ask(browser, "playground.race.task.obstacles(playground.race.layout, 20)") == later
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
    drawn = ask(browser, "playground.race.layout")
    wait(browser, lambda: "circles=" in browser.current_url)
    visit(browser, opened, f"#{browser.current_url.partition('#')[2]}")
    for mine, other in zip(ask(browser, "playground.race.layout.circles"), drawn["circles"], strict=True):
        assert mine == pytest.approx(other, abs=0.06)


def test_a_drone_that_nobody_flew_senses_obstacles_where_they_are_once_it_is_handed_over(browser, opened):
    visit(browser, opened, "#task=moving&pace=4&pilots=reactive~nobody~nobody~nobody&layout=3")
    steps(browser, 25)
    browser.execute_script("playground.handTo(1, 'reactive')")
    expected = "playground.race.task.obstacles(playground.race.layout, playground.race.steps)"
    # px, at the start
    near = f"Math.min(...{expected}.map(([x, y, r]) => Math.hypot(x - 400, y - 300) - r), 270)"
    waited, clearance = ask(
        browser, "(({ state, clearance }) => [state, clearance])(playground.race.drones[1])"
    )
    assert (waited["steps"], waited["waited"], waited["x"], waited["y"]) == (0, 25, 400, 300)
    assert clearance == pytest.approx(ask(browser, near), abs=1e-3)
    assert clearance != pytest.approx(ask(browser, near.replace("playground.race.steps", "0")), abs=1)
    steps(browser, 1)
    assert ask(browser, "playground.race.drones.map(({ state }) => state.steps)") == [26, 1, 0, 0]


def test_a_drone_that_waits_senses_obstacles_where_they_are_and_shows_it(browser, opened):
    visit(browser, opened, "#task=moving&layouts=random&pace=6&pilots=you~reactive~nobody~nobody&focus=1")
    steps(browser, 40)
    expected = "playground.race.task.obstacles(playground.race.layout, playground.race.steps)"
    near = ask(browser, f"Math.min(...{expected}.map(([x, y, r]) => Math.hypot(x - 400, y - 300) - r), 270)")
    assert states(browser)[0] == "waiting"
    assert ask(browser, "playground.race.drones[0].clearance") == pytest.approx(near, abs=1e-3)
    told = one(browser, "#sensor").get_attribute("aria-label")
    assert told.endswith(f"; the nearest edge at {near:.0f} px".replace("-", "−"))


def test_the_speed_that_is_shown_is_that_of_the_obstacles_also_of_a_split(browser, opened):
    fastest = "Math.max(...playground.race.layout.circles.map(([, , , vx, vy]) => Math.hypot(vx, vy)))"
    for split, most in (("random", 6), ("test", 2), ("random", 2)):
        if split == "random" and most == 6:
            visit(browser, opened, "#task=moving&layouts=random&pace=6")
        else:
            Select(one(browser, "#layouts")).select_by_value(split)
        assert one(browser, "#pace-now").text == f"{most} px/step"
        assert most / 2 < ask(browser, fastest) <= most
    visit(browser, opened, "#task=moving&layouts=test&pace=6")
    assert one(browser, "#pace-now").text == "2 px/step"


@pytest.mark.parametrize(("least", "most"), [(0, 4), (3, 7.25)])
def test_the_speed_that_is_shown_is_that_of_the_runs_task(least, most, chrome, tmp_path):
    fastest = "Math.max(...playground.race.layout.circles.map(([, , , vx, vy]) => Math.hypot(vx, vy)))"
    world = {"speed_min": least, "speed_max": most}
    write_policies(tmp_path / "run", n_seeds=1, task="moving", world=world)
    path = tmp_path / "playground.html"
    path.write_text(page(collect([tmp_path / "run"])))
    visit(chrome, path)
    assert one(chrome, "#pace-now").text == f"{most} px/step"
    assert most / 2 < ask(chrome, fastest) <= most + 1e-6
    link = ask(chrome, "writeLink(playground.scene, playground.data.settings)")
    visit(chrome, path, f"#{link}")
    assert not one(chrome, "#notice").is_displayed()
    Select(one(chrome, "#layouts")).select_by_value("random")
    slide(chrome, "pace", 2)
    assert one(chrome, "#pace-now").text == "2 px/step"
    assert ask(chrome, fastest) <= 2 + 1e-6


def test_an_edited_obstacle_leaves_what_sticks_as_it_is(browser, opened):
    visit(browser, opened, "#sticky=0.5&pilots=reactive~nobody~nobody~nobody")
    steps(browser, 3)
    before = ask(browser, "playground.race.drones[0].state.executed")
    browser.execute_script("playground.edit([])")
    assert ask(browser, "playground.race.drones[0].state.executed") == before == 9


def test_a_circle_stays_off_the_goal_in_a_drawing_and_in_a_link(browser, opened):
    visit(browser, opened, "#task=goal&layout=5")
    assert ask(browser, "playground.focus") == 0  # the first that can fly
    goal_x, goal_y = ask(browser, "playground.race.layout.goal")
    placed = "allowed(playground.world, [...arguments, 100], playground.race.free)"
    for at in ((goal_x, goal_y), (goal_x + 30, goal_y), (400, 300), (400, 449)):
        assert browser.execute_script(f"return {placed}", *at) is None
    assert browser.execute_script(f"return {placed}", -9, 700) == [0, 600, 100]
    assert np.hypot(goal_x, goal_y - 600) - 100 >= goal.ROOM
    for at, words in ((f"{goal_x:.1f}_{goal_y:.1f}", "circles"), ("0_600", "")):
        visit(browser, opened, f"#task=goal&layout=5&circles={at}_100")
        assert one(browser, "#notice").text.endswith(f": {words}." if words else "")
        assert bool(ask(browser, "playground.scene.circles")) != bool(words)


def test_faults_are_sliders_in_a_link_and_change_the_episodes(browser, opened):
    ends = []
    for value in (0, 0.5, 0):
        slide(browser, "sticky", value)
        steps(browser, 40)
        ends.append(ask(browser, "playground.race.drones.map(({ state }) => [state.x, state.y])"))
    assert ends[0] == ends[2] != ends[1]
    for name, value in (("noise", 5), ("lost", 0.1), ("late", 2)):
        slide(browser, name, value)
    assert one(browser, "#faults-now").text == "noise 5, lost 0.1, late 2"
    wait(browser, lambda: "&noise=5&lost=0.1&late=2&layouts=" in browser.current_url)
    steps(browser, 5)
    assert ask(browser, "playground.race.drones[1].state.seen.length") == 3


def test_a_link_restores_another_world_with_its_settings(browser, opened):
    scenes = (
        "task=slalom&gap=90&sticky=0.25&layouts=random&layout=4&k=8",
        "task=moving&pace=5.5&layouts=random&layout=1&k=3",
        "task=goal&noise=2&layouts=validation&layout=9",
    )
    for scene in scenes:
        link = f"{scene}&pilots=you~ppo-relu-1~nobody~reactive&focus=4&speed=2&greedy=no&seed=7"
        visit(browser, opened, f"#{link}")
        assert not one(browser, "#notice").is_displayed()
        found = ask(browser, "playground.scene")
        for part in scene.split("&"):
            name, _, value = part.partition("=")
            assert str(found[name]) == value
        assert ask(browser, "writeLink(playground.scene, playground.data.settings)") == link
    assert {*SETTINGS} <= {*found}


def test_a_link_restores_a_setting_without_which_the_page_opens(chrome, tmp_path):
    """Also none of a fault that the page's first policy was trained with."""
    write_policies(tmp_path / "faulty", n_seeds=1, faults={"late": 2})
    path = tmp_path / "playground.html"
    path.write_text(page(collect([tmp_path / "faulty"])))
    for late in (0, 4, 2):
        visit(chrome, path)
        assert ask(chrome, "playground.scene.late") == 2
        slide(chrome, "late", late)
        link = ask(chrome, "writeLink(playground.scene, playground.data.settings)")
        visit(chrome, path, f"#{link}")
        assert ask(chrome, "playground.scene.late") == late
