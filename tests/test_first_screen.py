"""The first screen of the committed report in a real browser: a sentence and five findings; below them the
table of rewards, the forest plot and the table of claims, and then drones that fly by themselves.
"""

import time

import pytest
from browsing import (
    NARROW,
    RESULTS,
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
    violations,
    wait,
)
from selenium.webdriver.common.keys import Keys
from tied import MOST_WORDS, words

pytestmark = pytest.mark.slow

REPORT = RESULTS / "report.html"
SCREENS = [(WIDE, 800), (NARROW, 844)]
PICTURES = "return [...document.querySelectorAll('.together canvas')].map((one) => one.toDataURL())"


def visit(browser, width=WIDE, height=800, motion="reduce", colours="light"):
    forget(browser)
    resize(browser, width, height)
    theme(browser, colours, motion)
    browser.get("about:blank")
    browser.get(REPORT.as_uri())
    wait(browser, lambda: one(browser, ".together output").text)
    return browser


@pytest.mark.parametrize(("width", "height"), SCREENS)
def test_the_sentence_and_five_findings_lie_within_a_wide_screen_and_begin_a_narrow_one(
    chrome, width, height
):
    visit(chrome, width, height)
    seen = find(chrome, "h1, .findings li")
    assert len(seen) == 1 + 5
    assert seen[0].tag_name == "h1"
    for element in seen if width == WIDE else seen[:3]:
        box = element.rect
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= width
        assert box["y"] >= 0
        assert box["y"] + box["height"] <= height
        assert min(box["width"], box["height"]) > 15
    assert complaints(chrome) == []


def test_rewards_forest_and_claims_follow_the_findings_and_drones_and_other_figures_come_after(chrome):
    visit(chrome)
    parts = "h1, .findings, caption, .plot, .claim, .together"
    shown = [
        element.get_attribute("id") or element.get_property("textContent") for element in find(chrome, parts)
    ]
    assert shown[2].startswith("Reward per episode: the paper's one run")
    assert shown[3] == "figure-forest"
    assert shown[4].startswith("The paper's claims: a grade in each of four columns")
    assert shown[5] == "claim-1"
    assert shown.index("claim-16") < shown.index("together") < shown.index("figure-configurations-episodes")
    assert one(chrome, ".first table").rect["y"] < one(chrome, "#figure-forest").rect["y"]
    assert one(chrome, "#verdicts .lead a[href$='limitations.md']").is_displayed()


def test_the_drones_fly_without_a_click_and_a_button_stops_them(chrome):
    visit(chrome, motion="no-preference")
    before = chrome.execute_script(PICTURES)
    assert len(set(before)) == 3
    wait(chrome, lambda: all(a != b for a, b in zip(chrome.execute_script(PICTURES), before, strict=True)))
    chrome.execute_script("arguments[0].focus()", one(chrome, ".together button"))
    press(chrome, Keys.SPACE)
    assert one(chrome, ".together button").text == "Play"
    still = chrome.execute_script(PICTURES)
    time.sleep(0.3)
    assert chrome.execute_script(PICTURES) == still
    assert [url for url in requested(chrome) if not url.startswith(("data:", "about:"))] == [REPORT.as_uri()]
    assert complaints(chrome) == []


def test_under_reduced_motion_the_drones_wait_in_mid_episode_until_they_are_asked(chrome):
    visit(chrome)
    before = chrome.execute_script(PICTURES)
    time.sleep(0.5)
    assert chrome.execute_script(PICTURES) == before
    assert "step 240" in find(chrome, ".together output")[-1].text  # of the rule, which flies on
    one(chrome, ".together button").click()
    wait(chrome, lambda: chrome.execute_script(PICTURES) != before)


def test_an_episode_that_ends_says_how_and_when(chrome):
    visit(chrome)
    words = "const page = document.getElementById('together').cloneNode(true);"
    words += "const data = JSON.parse(document.getElementById('together-data').textContent);"
    words += (
        "const one = new Together(page, data); return one.load(0).then(() => { one.step = 1e9; one.draw();"
    )
    words += "return one.drones.map(({ output, episode }) =>"
    words += " [output.textContent, episode.ended, episode.steps]); })"
    for said, ended, n in chrome.execute_script(words):
        assert said.endswith(f", {'collided' if ended == 'collision' else 'stopped'} at step {n:,}")


def test_the_palette_of_a_site_recolours_the_drones(chrome):
    visit(chrome)
    before = chrome.execute_script(PICTURES)
    chrome.execute_script(
        "document.querySelector('.together').style.cssText ="
        " '--drone-1: red; --drone-2: red; --drone-3: red';"
        "document.body.setAttribute('data-md-color-scheme', 'slate')"
    )
    wait(chrome, lambda: all(a != b for a, b in zip(chrome.execute_script(PICTURES), before, strict=True)))


def test_the_sentence_is_short_and_its_number_leads_to_its_row_and_the_drones_have_names(chrome):
    visit(chrome)
    assert 5 < len(words(one(chrome, "h1").text)) <= MOST_WORDS
    link = one(chrome, "h1 a")
    assert link.get_dom_attribute("href").startswith("#row-verdicts-")
    chrome.execute_script("arguments[0].click()", link)
    wait(chrome, lambda: one(chrome, "tr:target").is_displayed())
    assert "0.878" in one(chrome, "tr:target").text  # the share that the sentence has in %
    names = [
        canvas.get_dom_attribute("aria-label").split(",")[0] for canvas in find(chrome, ".together canvas")
    ]
    assert [name.split()[0] for name in names] == ["PPO", "DQN", "scripted"]
    shown = "return [...document.querySelectorAll('.together strong')].map((one) => one.textContent)"
    assert chrome.execute_script(shown) == names


def test_at_390_px_every_figure_is_whole_and_drawn_for_it_with_words_that_can_be_read(chrome):
    visit(chrome, NARROW, 844)
    unfold(chrome)
    pictures = find(chrome, ".plot img")
    assert len(pictures) == len([*(RESULTS / "figures").glob("*.svg")])
    for picture in pictures:
        wait(chrome, lambda picture=picture: picture.get_property("naturalWidth"))
        shown, drawn = picture.rect["width"], picture.get_property("naturalWidth")
        assert picture.rect["x"] >= 0
        assert picture.rect["x"] + shown <= NARROW
        assert shown / drawn * 16 > 11  # [px] of letters that are drawn with 12 pt


def test_the_page_takes_less_than_6_mb():
    assert REPORT.stat().st_size < 6e6


@pytest.mark.parametrize(("width", "colours"), [(WIDE, "light"), (NARROW, "dark")])
def test_axe_finds_nothing_on_the_page_as_it_opens(chrome, width, colours):
    visit(chrome, width, colours=colours)
    chrome.execute_script(
        "document.querySelectorAll('details > :not(summary)').forEach((one) => one.remove())"
    )
    assert violations(chrome) == []


def test_a_claim_opens_by_enter_and_shows_its_table_and_closes_again(chrome):
    visit(chrome)
    unfold(chrome)
    summary, table = one(chrome, "#claim-1 summary"), one(chrome, "#claim-1 table")
    chrome.execute_script("document.getElementById('claim-1').open = false")
    assert not table.is_displayed()
    chrome.execute_script("arguments[0].focus()", summary)
    press(chrome, Keys.ENTER)
    wait(chrome, table.is_displayed)
    assert {"the paper", "Holm's p", "seeds", "verdict"} < {
        head.get_property("textContent") for head in find(chrome, "#claim-1 table:first-of-type thead th")
    }
    press(chrome, Keys.ENTER)
    wait(chrome, lambda: not table.is_displayed())
