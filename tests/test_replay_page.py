"""Replays of other worlds in a real browser, on the page of `uavnav compare`."""

from types import SimpleNamespace as State3D

import pytest
import torch
from browsing import WIDE, ask, complaints, find, forget, one, requested, visit, wait
from replaying import STRAIGHT
from runs_by_hand import rows, write_policies
from selenium.webdriver.support.ui import Select

from uavnav.evaluation import Protocol
from uavnav.report import configurations, templating
from uavnav.report.compare import Contender, page
from uavnav.tasks import layouts
from uavnav.tasks.moving import MovingWorld, motion
from uavnav.tasks.space import SpaceMovingWorld, to_body
from uavnav.views import replays

pytestmark = pytest.mark.slow

ABOVE = torch.tensor([[[400.0, 520.0, 180.0]]])
"""A layout file of one goal straight ahead and no circle."""
EPISODE = (10, 10, 1, 0, 2, 50, 1.0)
"""Of `rows`."""
PICTURE = "document.querySelector('.replay-arena canvas').toDataURL()"
PICTURES = "[...document.querySelectorAll('.replay-arena canvas')].map((one) => one.toDataURL())"


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """A page with a run among moving obstacles and one that flies straight to its goal."""
    folder = tmp_path_factory.mktemp("compared")
    write_policies(folder / "moving", task="moving", n_seeds=1, prefer=[(0, 0)])
    write_policies(folder / "goal", task="goal", n_seeds=1, n_inputs=33, prefer=[(0, STRAIGHT)])
    write_policies(folder / "box", task="space-moving", n_seeds=1, n_inputs=40)
    protocol = Protocol().header()
    contenders = [
        Contender(
            name, rows(0, EPISODE, EPISODE), protocol, {"task": "drone"}, configurations.read(folder / name)
        )
        for name in ("moving", "goal", "box")
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(replays.record, "__defaults__", (1, 1, 60))
        layouts = replays._layouts
        patch.setattr(
            replays,
            "_layouts",
            lambda task, split: ABOVE if hasattr(task.world, "goal_radius") else layouts(task, split),
        )
        (folder / "compare.html").write_bytes(page(contenders))
    return folder / "compare.html"


def test_obstacles_stand_where_they_stood_at_each_step_and_a_reached_goal_is_told(chrome, compared):
    forget(chrome)
    visit(chrome, compared, width=WIDE)
    status = one(chrome, ".replay-status")
    wait(chrome, lambda: status.text.startswith("step 0 of "))
    choice = Select(one(chrome, ".replay select"))
    assert [option.text for option in choice.options] == [
        "PPO (moving), sampled, moving obstacles",
        "PPO (goal), sampled, a goal",
        "PPO (box), sampled, a box in 3D, moving spheres",
    ]
    data = "JSON.parse(document.getElementById('replay-data').textContent)"
    read = {"world", "layouts", "actions", "values", "fields", "configurations"}
    assert {*ask(chrome, f"Object.keys({data})")} == read
    there = ask(chrome, f"around({data}, {data}.configurations[0], {{ layout: 0 }}, 7).circles")
    all_layouts = layouts.load("test", MovingWorld())[:1]
    obstacles, velocities = motion(all_layouts, torch.tensor([7]), MovingWorld())
    assert torch.tensor(there).sub(torch.cat([obstacles, velocities], -1)[0]).abs().max() <= 1e-4
    before = ask(chrome, PICTURE)
    one(chrome, ".replay [aria-label='one step forward']").click()  # it stays, and they move
    assert status.text.startswith("step 1 of ")
    assert ask(chrome, PICTURE) != before
    choice.select_by_index(1)
    wait(chrome, lambda: status.text.startswith("step 0 of 20: "))
    words = "const one = document.querySelector('.replay [type=range]'); one.value = 20;"
    chrome.execute_script(f"{words} one.dispatchEvent(new Event('input'))")
    assert status.text.endswith("goal reached")
    assert "goal at 20" in one(chrome, ".replay .replay-row").text
    assert complaints(chrome) == []
    assert {url for url in requested(chrome) if not url.startswith("data:")} <= {
        compared.as_uri(),
        "about:blank",
    }


def test_a_box_is_seen_from_above_and_from_the_side_with_its_spheres_and_what_the_drone_senses_where_they_are(
    chrome, compared
):
    visit(chrome, compared, width=WIDE)
    Select(one(chrome, ".replay select")).select_by_index(2)
    status = one(chrome, ".replay-status")
    wait(chrome, lambda: status.text.startswith("step 0 of "))
    world, data = SpaceMovingWorld(), "JSON.parse(document.getElementById('replay-data').textContent)"
    there = ask(chrome, f"around({data}, {data}.configurations[2], {{ layout: 0 }}, 7).spheres")
    all_layouts = layouts.load("test", world)[:1]
    assert torch.tensor(there).sub(motion(all_layouts, torch.tensor([7]), world)[0][0]).abs().max() <= 1e-4
    drone = State3D(x=0.0, y=0.0, z=0.0, heading=torch.tensor(30), pitch=torch.tensor(-14))
    axes = ask(chrome, "bodyAxes({ yaw: radians(30), pitch: radians(-14) })")
    assert torch.tensor(axes).sub(torch.stack(to_body(torch.eye(3), drone))).abs().max() <= 1e-6
    empty, ahead = [0, 0, 0, 1], [0, 0, 1, 0.5]  # halfway between the drone's edge and the sensor's reach
    (point,) = ask(chrome, f"sensedPoints({world.model_dump_json()}, [1, 2, 3], {axes}, [{ahead}, {empty}])")
    assert point == pytest.approx([at + 75 * part for at, part in zip((1, 2, 3), axes[2], strict=True)])
    views = find(chrome, ".replay-arena canvas")
    for canvas, side in zip(views, ("above", "the side"), strict=True):
        assert canvas.get_dom_attribute("aria-label") == f"The box at step 0 of 60, seen from {side}"
        assert canvas.size["width"] / canvas.size["height"] == pytest.approx(800 / 600, rel=0.02)
    before = ask(chrome, PICTURES)
    one(chrome, ".replay [aria-label='one step forward']").click()
    assert all(now != then for now, then in zip(ask(chrome, PICTURES), before, strict=True))
    Select(one(chrome, ".replay select")).select_by_index(0)
    assert [canvas.is_displayed() for canvas in views] == [True, False]
    assert complaints(chrome) == []


def test_a_page_that_loads_itself_again_shows_the_same_step_of_the_same_episode(chrome, compared, tmp_path):
    script = str(templating.TEMPLATES.globals["renewing"])
    for clock, by_hand in (("AGAIN = 5000", "AGAIN = 0"), ("setInterval(", "addEventListener('again', ")):
        assert script.count(clock) == 1
        script = script.replace(clock, by_hand)
    path = tmp_path / "watched.html"
    path.write_text(compared.read_text().replace("</body>", f"<script>{script}</script></body>"))
    forget(chrome)
    visit(chrome, path, width=WIDE)
    Select(one(chrome, ".replay select")).select_by_index(1)
    Select(one(chrome, ".replay [data-part=speed]")).select_by_visible_text("4×")
    wait(chrome, lambda: one(chrome, ".replay-status").text.startswith("step 0 of 20: "))
    words = "const one = document.querySelector('.replay [type=range]'); one.focus(); one.value = 12;"
    chrome.execute_script(f"window.before = true; {words} one.dispatchEvent(new Event('input'))")
    assert one(chrome, ".replay-status").text.startswith("step 12 of 20: ")
    chrome.execute_script("dispatchEvent(new Event('again'))")
    wait(chrome, lambda: not ask(chrome, "window.before"))
    shown = "[...document.querySelectorAll('.replay select')].map((one) => one.selectedOptions[0].text)"
    wait(chrome, lambda: ask(chrome, "document.querySelector('.replay-status')?.textContent[5] === '1'"))
    assert ask(chrome, "document.querySelector('.replay-status').textContent").startswith("step 12 of 20: ")
    assert ask(chrome, shown) == ["PPO (goal), sampled, a goal", "0", "1 (goal at 20)", "4×"]
    assert ask(chrome, "document.activeElement.type") == "range"
    assert complaints(chrome) == []
