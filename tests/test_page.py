"""The report's page in a real browser: what a reader sees, clicks and types, and that nothing comes from
elsewhere.
"""

import itertools
import json
import re
import time
from pathlib import Path

import pytest
from browsing import (
    FONTS,
    NARROW,
    PAIRS,
    WIDE,
    complaints,
    find,
    forget,
    one,
    press,
    requested,
    resize,
    theme,
    unfold,
    wait,
)
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select

from uavnav.algorithms import dqn, ppo
from uavnav.evaluation import evaluate_run
from uavnav.report import report
from uavnav.report.claims import CLAIMS
from uavnav.report.page import FURTHER, SECTIONS
from uavnav.report.verdicts import GRADES

pytestmark = pytest.mark.slow

RESULTS = Path(__file__).parent.parent / "results"
SHOWN = {name: title for name, title in SECTIONS.items() if name not in ("algorithms", "worlds", *FURTHER)}
"""Sections of a report without further studies."""

SMALL = {"preset": "vectorised", "total_frames": 2048, "hidden": (16,), "n_seeds": 2, "compile": "off"}


def make_page(folder):
    """The page of two small configurations, their runs evaluated on six layouts."""
    for algorithm, train, config in (
        ("ppo", ppo.train, ppo.PPOConfig(frames_per_batch=512, epochs=2, **SMALL)),
        ("dqn", dqn.train, dqn.DQNConfig(learning_starts=256, frames_per_update=16, **SMALL)),
    ):
        run = train(config, out=folder / "runs" / algorithm / "tanh", quiet=True)
        evaluate_run(run, episodes=6, max_steps=200)
        (run.path / "meta.json").write_text(json.dumps(run.meta | {"study": "small"}))
    report([folder / "runs"], folder / "report")


@pytest.fixture(scope="module")
def page(once, warm_module):
    return once("page", make_page) / "report" / "report.html"


@pytest.fixture
def browser(chrome, page):
    """The page, freshly opened, wide and light."""
    forget(chrome)
    resize(chrome, WIDE)
    theme(chrome, "light")
    chrome.get(page.as_uri())
    yield chrome
    chrome.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": False})
    assert complaints(chrome) == []


def value(slider):
    return int(slider.get_property("value"))


def scrub(browser, slider, step):
    browser.execute_script(
        "arguments[0].value = arguments[1]; arguments[0].dispatchEvent(new Event('input'))", slider, step
    )


@pytest.fixture
def player(browser):
    """The player, its section unfolded and its first episode unpacked."""
    browser.execute_script("document.querySelector('#episodes details').open = true")
    status = one(browser, ".replay-status")
    wait(browser, lambda: status.text.startswith("step 0 of "))
    return one(browser, ".replay")


def test_one_file_below_25_mb_loads_nothing_else_and_complains_of_nothing(browser, page, player):
    assert page.stat().st_size < 25e6
    player.find_element(By.CSS_SELECTOR, "[data-act=toggle]").click()
    asked = requested(browser)
    assert page.as_uri() in asked
    assert [url for url in asked if url != page.as_uri() and not url.startswith("data:")] == []
    assert browser.get_log("browser") == []


def test_every_figure_is_drawn_and_has_words_a_caption_and_a_size(browser):
    unfold(browser)
    pictures = find(browser, "img")
    assert len(pictures) == len(find(browser, "figure.plot")) >= 8
    for picture in pictures:
        assert picture.get_property("complete")
        assert picture.get_property("naturalWidth") > 0
        assert len(picture.get_attribute("alt")) > 20
    assert all(caption.text for caption in find(browser, "figure.plot figcaption"))
    drawn = {figure.get_attribute("id").removeprefix("figure-") for figure in find(browser, "figure.plot")}
    assert drawn >= {
        "curves-ppo-reward",
        "curves-dqn-reward",
        "trajectories",
        "heat",
        "survival",
    }


def test_the_committed_page_draws_every_committed_figure_and_unpacks_an_episode_of_each_of_8_configurations(
    browser,
):
    browser.get((RESULTS / "report.html").as_uri())
    unfold(browser)
    drawn = {figure.get_attribute("id").removeprefix("figure-") for figure in find(browser, "figure.plot")}
    assert drawn == {path.stem for path in (RESULTS / "figures").glob("*.svg")}
    assert all(picture.get_property("naturalWidth") > 0 for picture in find(browser, "img"))
    configuration, seed, layout = (Select(select) for select in find(browser, ".replay > .replay-row select"))
    assert [len(one.options) for one in (configuration, seed, layout)] == [8, 3, 3]
    status = one(browser, ".replay-status")
    for option in range(8):
        configuration.select_by_index(option)
        wait(browser, lambda: status.text.startswith("step 0 of "))
        assert int(one(browser, ".replay [type=range]").get_attribute("max")) > 0


def test_headings_are_in_order_and_the_verdicts_come_first(browser):
    levels = [int(heading.tag_name[1]) for heading in find(browser, "h1, h2, h3, h4, h5, h6")]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(after <= before + 1 for before, after in itertools.pairwise(levels))
    assert [section.get_attribute("id") for section in find(browser, "main > section")] == list(SHOWN)
    assert find(browser, "main > section")[0].get_attribute("id") == "verdicts"
    assert browser.execute_script("return document.documentElement.lang") == "en"


def test_each_link_of_the_navigation_leads_to_its_section_and_stays_in_view(browser):
    folded = find(browser, ".fold")
    assert len(folded) == len(SHOWN) - 1
    assert not [one for one in folded if one.get_property("open")]
    links = find(browser, "nav a")
    assert [link.text for link in links] == list(SHOWN.values())
    for name, link in zip(SHOWN, links, strict=True):
        browser.execute_script("arguments[0].click()", link)
        assert name == "verdicts" or one(browser, f"#{name} details").get_property("open"), name
        assert not find(browser, ".claim[open]")
        top = browser.execute_script(
            "return document.getElementById(arguments[0]).getBoundingClientRect().top", name
        )
        # of the page below what is seen: the last sections cannot come to the top
        bottom = browser.execute_script(
            "return document.documentElement.scrollHeight - scrollY - innerHeight"
        )
        assert 0 <= top < 150 or (bottom < 2 and top < 900), name
        assert link.is_displayed()
        assert link.rect["y"] - browser.execute_script("return scrollY") < 150 or name == "verdicts"


@pytest.mark.parametrize("width", [WIDE, NARROW])
def test_the_findings_of_the_committed_page_come_first_and_each_number_is_a_link_on_one_line(browser, width):
    browser.get((RESULTS / "report.html").as_uri())
    resize(browser, width)
    shown = find(browser, ".findings li")
    assert len(shown) == 5
    assert shown[-1].rect["y"] + shown[-1].rect["height"] < (800 if width == WIDE else 1400)
    assert shown[-1].rect["y"] < one(browser, ".claim").rect["y"]
    for one_finding in shown:
        links = one_finding.find_elements(By.CSS_SELECTOR, "a")
        assert links
        for link in links:
            row = one(browser, f"[id='{link.get_dom_attribute('href').removeprefix('#')}']")
            assert row.tag_name in ("tr", "table")
            assert len(browser.execute_script("return [...arguments[0].getClientRects()]", link)) == 1


def test_each_claim_shows_its_number_and_its_verdict_in_a_word_and_a_sign_without_being_opened(browser):
    claims = find(browser, ".claim")
    assert [claim.find_element(By.CSS_SELECTOR, ".number").text for claim in claims] == [
        str(n) for n in range(1, len(CLAIMS) + 1)
    ]
    for claim in claims:
        assert claim.get_property("open") is False
        badge = claim.find_element(By.CSS_SELECTOR, "summary .badge")
        assert re.fullmatch(r".* \((training|final|other).*\)", badge.text)  # the column of its grade
        assert badge.text.split(" (")[0] in GRADES
        sign = browser.execute_script("return getComputedStyle(arguments[0], '::before').content", badge)
        assert dict(zip(GRADES, "✓◐↓✗?i", strict=True))[badge.text.split(" (")[0]] in sign
        said = claim.find_element(By.CSS_SELECTOR, ".said").text
        assert re.search(r"\d", said) or said == "No part that counts has runs."


def test_a_replay_plays_pauses_by_space_and_its_end_says_what_happened(browser, player):
    slider, status = one(browser, ".replay [type=range]"), one(browser, ".replay-status")
    last = int(slider.get_attribute("max"))
    assert last > 0
    # too slow to end meanwhile
    Select(one(browser, ".replay-transport select")).select_by_visible_text("0.25×")
    browser.execute_script("arguments[0].focus()", player)
    press(browser, Keys.SPACE)
    wait(browser, lambda: value(slider) > 1)
    press(browser, Keys.SPACE)
    assert one(browser, ".replay-transport button:nth-of-type(2)").text == "Play"
    there = value(slider)
    time.sleep(0.3)
    assert value(slider) == there
    press(browser, Keys.ARROW_RIGHT)
    assert value(slider) == there + 1
    assert status.text.startswith(f"step {there + 1} of {last}: reward so far ")
    Select(one(browser, ".replay-transport select")).select_by_visible_text("4×")
    scrub(browser, slider, max(last - 20, 0))
    one(browser, ".replay [data-act=toggle]").click()
    wait(browser, lambda: value(slider) == last, 30)
    wait(browser, lambda: status.text.endswith(("collision", "truncated")))


def test_a_replay_scrubs_and_the_picture_and_the_words_follow(browser, player):
    slider, status = one(browser, ".replay [type=range]"), one(browser, ".replay-status")
    picture = "return document.querySelector('.replay-arena canvas').toDataURL()"
    before, target = browser.execute_script(picture), int(slider.get_attribute("max")) // 2
    assert target > 1
    scrub(browser, slider, target)
    assert status.text.startswith(f"step {target} of ")
    assert browser.execute_script(picture) != before
    slider.send_keys(Keys.ARROW_RIGHT)
    assert status.text.startswith(f"step {target + 1} of ")


def test_configurations_seeds_and_obstacles_can_be_chosen(browser, player):
    configuration, seed, layout = (Select(select) for select in find(browser, ".replay > .replay-row select"))
    assert [option.text for option in configuration.options] in (
        ["PPO tanh, sampled", "DQN tanh, sampled"],
        ["DQN tanh, sampled", "PPO tanh, sampled"],
    )
    caption, status, shown = one(browser, ".replay-side figcaption"), one(browser, ".replay-status"), set()
    for name, words in (("PPO tanh, sampled", "probability"), ("DQN tanh, sampled", "Q value")):
        configuration.select_by_visible_text(name)
        wait(browser, lambda words=words: caption.text.startswith(words))
        assert [option.text for option in seed.options] == ["0", "1"]
        for n in (0, 1):
            seed.select_by_index(n)
            assert len(layout.options) == 3
            for place in range(3):
                layout.select_by_index(place)
                steps = re.search(r"at (\d+)\)", layout.first_selected_option.text)[1]
                wait(browser, lambda steps=steps: status.text.startswith(f"step 0 of {steps}: "))
                shown.add(
                    browser.execute_script(
                        "return document.querySelector('.replay-arena canvas').toDataURL()"
                    )
                )
    assert len(shown) >= 3  # every layout looks otherwise


@pytest.mark.parametrize("width", [WIDE, NARROW])
def test_nothing_is_wider_than_the_screen_and_no_text_smaller_than_12_px(browser, player, width):
    resize(browser, width)
    unfold(browser)
    assert browser.execute_script("return innerWidth") == width
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    assert browser.execute_script(FONTS) == []
    for box in find(browser, ".scroll, .plot img"):
        assert box.rect["x"] >= 0
        assert box.rect["x"] + box.rect["width"] <= width
    for control in find(browser, ".replay select, .replay button, .replay input"):
        assert control.rect["x"] + control.rect["width"] <= width
        assert control.rect["height"] >= 24


def test_every_box_that_scrolls_is_reached_by_the_keyboard_and_has_a_name(browser):
    boxes = "return [...document.querySelectorAll('.scroll')].map(box => [box.tabIndex, box.ariaLabel])"
    found = browser.execute_script(boxes)
    assert len(found) > 10
    assert all(index == 0 and name for index, name in found)


def test_at_390_px_a_wide_table_is_cards_that_name_their_numbers_and_no_table_needs_to_scroll(browser):
    resize(browser, NARROW)
    unfold(browser)
    sizes = (
        "return [...document.querySelectorAll('.scroll')].map(box => [box.ariaLabel, box.scrollWidth, "
        "box.clientWidth])"
    )
    assert [name for name, inside, width in browser.execute_script(sizes) if inside > width] == []
    row = one(browser, "#tables .cards tbody tr")
    named = browser.execute_script(
        "return getComputedStyle(arguments[0].children[2], '::before').content", row
    )
    assert named.strip('"').strip() == find(browser, "#tables .cards thead th")[2].get_property("textContent")
    roles = (
        "return [...document.querySelectorAll('.cards :is(tr, td)')].every(one => one.hasAttribute('role'))"
    )
    assert browser.execute_script(roles)  # who listens still hears a table


@pytest.mark.parametrize("name", ["light", "dark"])
def test_every_text_has_a_contrast_of_at_least_4_5(browser, player, name):
    theme(browser, name)
    unfold(browser)
    ratios = browser.execute_script(PAIRS)
    assert {"P lead", "P kicker", "SPAN said", "SPAN interval", "SPAN badge open", "P replay-status"} <= {
        *ratios
    }
    assert {element: ratio for element, ratio in ratios.items() if ratio < 4.5} == {}
    for kind in ("replicates", "in-part", "does-not", "open", "context"):
        browser.execute_script(f"document.querySelector('#claim-1 .badge').className = 'badge {kind}'")
        assert browser.execute_script(PAIRS)[f"SPAN badge {kind}"] >= 4.5, kind


def test_dark_is_dark_and_the_replay_is_drawn_again(browser, player):
    look = "return getComputedStyle(document.body).backgroundColor"
    picture = "return document.querySelector('.replay-arena canvas').toDataURL()"
    light = browser.execute_script(look), browser.execute_script(picture)
    theme(browser, "dark")
    wait(browser, lambda: browser.execute_script(picture) != light[1])
    assert [max(map(int, re.findall(r"\d+", one))) for one in (light[0], browser.execute_script(look))] == [
        251,
        27,
    ]


def test_tab_reaches_navigation_claims_folds_and_player_in_order_with_an_outline(browser, player):
    reached = []
    for _ in range(90):
        press(browser, Keys.TAB)
        name, inside, style, width = browser.execute_script(
            "const one = document.activeElement, style = getComputedStyle(one);"
            "return [one.tagName + ' ' + (one.getAttribute('aria-label') || one.textContent).slice(0, "
            "30).trim(),"
            " one.closest('.skip, .together, nav, .claim, .replay, .fold > summary, .scroll, details')"
            "?.className ?? 'nav',"
            " style.outlineStyle, parseFloat(style.outlineWidth)]"
        )
        if name.startswith("BODY"):
            break
        assert (style, width >= 2) == ("solid", True), name
        reached.append((inside, name))
    kinds = [kind for kind, _ in itertools.groupby(inside for inside, _ in reached)]
    order = [kinds.index(kind) for kind in ("skip", "", "claim", "first together", "replay")]
    assert order == sorted(order)
    folds = [name.split()[0] for _, name in reached if name.startswith("SUMMARY")]
    assert len(folds) >= len(CLAIMS) + len(SHOWN) - 1
    assert sum(inside == "claim" for inside, _ in reached) == len(CLAIMS)
    assert [name.split()[0] for inside, name in reached if inside == "replay"] == (
        ["DIV", "SELECT", "SELECT", "SELECT", "BUTTON", "BUTTON", "BUTTON", "SELECT", "INPUT"]
    )


def test_print_shows_all_that_is_folded(browser):
    table = one(browser, "#methods table")
    assert not table.is_displayed()
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    assert table.rect["height"] > 100
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
    assert not table.is_displayed()


def test_without_javascript_the_sentence_and_the_verdicts_are_there_and_the_replays_say_what_they_need(
    browser,
):
    browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": True})
    browser.refresh()
    assert one(browser, "h1").text
    assert not one(browser, ".together").is_displayed()
    assert len(find(browser, ".claim summary .badge")) == len(CLAIMS)
    assert all(badge.is_displayed() for badge in find(browser, ".claim summary .badge"))
    assert one(browser, "noscript").get_property("textContent") == "The replays need JavaScript."
    assert find(browser, ".replay") == []
