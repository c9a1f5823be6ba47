"""Replays of other worlds in a real browser, on the page of `uavnav compare`."""

import pytest
import torch
from browsing import WIDE, ask, complaints, forget, one, requested, visit, wait
from selenium.webdriver.support.ui import Select
from test_compare import made_up
from test_replays import STRAIGHT, write_run

from uavnav.report import cells, replays
from uavnav.report.compare import page
from uavnav.tasks import layouts
from uavnav.tasks.moving import MovingWorld, motion

pytestmark = pytest.mark.slow

ABOVE = torch.tensor([[[400.0, 520.0, 180.0]]])
"""A bank of one goal straight ahead and no circle."""
PICTURE = "document.querySelector('.replay-arena canvas').toDataURL()"


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """A page with a run among moving obstacles and one that flies straight to its goal."""
    folder = tmp_path_factory.mktemp("compared")
    write_run(folder / "moving", task="moving", n_seeds=1, prefer=[(0, 0)])
    write_run(folder / "goal", task="goal", n_seeds=1, n_inputs=33, prefer=[(0, STRAIGHT)])
    contenders = [
        made_up(name, [1.0, 2.0])._replace(cell=cells.read(folder / name), name=name) for name in ("moving", "goal")
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(replays.record, "__defaults__", (1, 1, 60))
        bank = replays._bank
        patch.setattr(replays, "_bank", lambda task, *sets: ABOVE if hasattr(task.world, "goal_radius") else bank(task))
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
    ]
    data = "JSON.parse(document.getElementById('replay-data').textContent)"
    there = ask(chrome, f"around({data}, {data}.cells[0], {{ layout: 0 }}, 7).circles")
    bank = layouts.load("test", MovingWorld())[:1]
    obstacles, velocities = motion(bank, torch.tensor([7]), MovingWorld())
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
    assert {url for url in requested(chrome) if not url.startswith("data:")} <= {compared.as_uri(), "about:blank"}
