"""Whole episodes in every world: all that is sensed, moved, hit, reached, earned and counted, against
slow loops.
"""

import oracle
import pytest
import torch
from slow_episodes import KINDS, slow_episodes, take_over

from uavnav.tasks import slalom
from uavnav.tasks.state import COUNTS
from uavnav.tasks.table import make_task

FASTER = {"speed_min": 3.0, "speed_max": 5.0, "sense_velocity": True}


@pytest.mark.parametrize(
    ("seed", "drawn", "reward"),
    [*zip(range(4), oracle.SWITCHES, [None, "eq14", "additive", "initial"], strict=True)],
)
@pytest.mark.parametrize(
    ("name", "fields"), [*((name, {}) for name in KINDS), ("moving", FASTER), ("space-moving", FASTER)]
)
def test_25_whole_episodes_equal_a_loop_that_turns_moves_lets_obstacles_move_senses_and_judges(
    name, fields, seed, drawn, reward
):
    """Those of the paper's world lead through a slalom; a quarter of those to a goal begins 48 px away
    from it.
    """
    task = make_task("slalom-160/test" if name == "drone" else "test", fields | drawn, reward, 40, task=name)
    task = task.replace(layouts=task.layouts[:100])
    generator, rows = torch.Generator().manual_seed(seed), torch.arange(25)
    state = task.start(25 * seed + rows, 180 * (rows % 2))
    if name == "goal":
        goals = task.layouts[state.layout[:14:2], -1]
        state.x[:14:2], state.y[:14:2] = goals[:, 0] - 48, goals[:, 1]
    episodes = slow_episodes(task, state.layout.tolist(), state.heading.tolist())
    for row, episode in enumerate(episodes):
        episode.x, episode.y = state.x[row].item(), state.y[row].item()
    straight, up, doubtful, passages = 3 if "space" in name else 9, {*range(25)}, 0, 0
    whole = {"heading", "pitch", *COUNTS[:-1]} & {*state._fields}
    ends = {"collided": 0, "reached": 0, "capped": 0}
    while up:
        flies = torch.randint(3, (25,), generator=generator) > 1
        action = torch.where(flies, straight, torch.randint(100, (25,), generator=generator)).tolist()
        before, (state, outcome) = state, task.step(state, torch.tensor(action))
        found = type(state)(*(part.tolist() for part in state))
        succeeded = task.measure(before, state).get("succeeded", torch.zeros(25)).tolist()
        passed = slalom.passages(before, state)["passages"].tolist()
        places, (over, capped) = before.x.tolist(), (part.tolist() for part in outcome[-2:])
        seen = []
        for row in sorted(up):
            episode = episodes[row]
            episode.step(action[row])
            take_over(episode, found, row)
            assert all(getattr(found, field)[row] == getattr(episode, field) for field in whole)
            sides = [sum(x > column for column in (150, 290, 510, 650)) for x in (places[row], episode.x)]
            assert passed[row] == abs(sides[1] - sides[0])
            passages += passed[row]
            if episode.doubtful():
                doubtful += 1
            else:
                assert (over[row], capped[row]) == (episode.terminated, episode.truncated)
                assert outcome.reward[row].item() == pytest.approx(episode.reward, abs=2e-5)
                assert succeeded[row] == (episode.terminated and episode.clearance > 30)
                seen.append((row, sum(episode.slots, ())))
            if over[row] or capped[row]:
                up.remove(row)
                ends["capped" if capped[row] else "collided" if episode.clearance <= 30 else "reached"] += 1
        kept, expected = zip(*seen, strict=True)
        torch.testing.assert_close(outcome.observation[[*kept]], torch.tensor(expected), rtol=0, atol=1e-4)
    assert min(ends["collided"], ends["capped"]) > 0
    assert ends["reached"] > 3 or name != "goal"
    assert passages > 3 or name != "drone"
    assert doubtful < 60
