"""Gymnasium's and Stable-Baselines3's views of the world: the same episodes, info, autoreset and pictures."""

import functools
import itertools
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import uavnav
from uavnav.envs import drawing
from uavnav.envs.gym import DroneGymEnv
from uavnav.tasks import layouts

STRAIGHT = 9  # no turn, 9 px


@pytest.fixture(scope="module")
def all_layouts():
    return layouts.load("test").tolist()


def make(**how):
    return gymnasium.make("uavnav/Drone-v0", layouts="test", **how)


def make_vec(num_envs, **how):
    return gymnasium.make_vec("uavnav/Drone-v0", num_envs=num_envs, **{"layouts": "test"} | how)


def random_actions(*shape, seed=0):
    return np.random.default_rng(seed).integers(100, size=shape)


def test_gymnasiums_checker_has_nothing_to_warn_about_where_it_renders_too():
    with warnings.catch_warnings(action="error"):
        check_env(make(render_mode="rgb_array").unwrapped)


def test_the_spaces_are_30_numbers_and_100_actions():
    env = make()
    assert env.action_space == gymnasium.spaces.Discrete(100)
    assert env.observation_space.shape == (30,)
    assert env.observation_space.dtype == np.float32
    assert env.observation_space.low[:3].tolist() == [-1, 0, 0]
    assert env.observation_space.high.tolist() == [1] * 30


def test_info_has_5_plain_numbers():
    _, info = make().reset(seed=0)
    assert {name: type(value) for name, value in info.items()} == {
        "layout": int,
        "x": float,
        "y": float,
        "heading": int,
        "clearance": float,
    }


def test_a_seed_fixes_the_place_and_each_of_3_later_resets_advances_by_one():
    env, other = make(), make()
    place = env.reset(seed=5)[1]["layout"]
    assert [env.reset()[1]["layout"] for _ in range(3)] == [(place + i) % 1000 for i in (1, 2, 3)]
    assert env.reset(seed=5)[1]["layout"] == other.reset(seed=5)[1]["layout"] == place
    assert len({env.reset(seed=seed)[1]["layout"] for seed in range(20)}) > 15


def test_options_pick_layout_3_and_the_next_reset_takes_4_and_after_999_comes_0():
    env = make()
    assert env.reset(options={"layout": 3})[1]["layout"] == 3
    assert env.reset()[1]["layout"] == 4
    assert env.reset(seed=1, options={"layout": 999})[1]["layout"] == 999
    assert env.reset()[1]["layout"] == 0


@pytest.mark.parametrize("made", [make, functools.partial(make_vec, 2)])
def test_a_reset_to_a_layout_that_is_not_there_leaves_the_seed_as_it_was(made):
    env, other = made(), made()
    for one in (env, other):
        one.reset(seed=0)
    with pytest.raises(ValueError, match="layout"):
        env.reset(seed=1, options={"layout": 1_000_000})
    assert np.array_equal(env.reset()[1]["layout"], other.reset()[1]["layout"])
    assert np.array_equal(env.np_random.random(3), other.np_random.random(3))


def test_for_people_each_step_is_a_picture_in_a_window_that_closes(monkeypatch):
    pygame = pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = DroneGymEnv(render_mode="human")
    env.reset(seed=0)
    env.step(9)
    assert env.render() is None
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
    assert np.array_equal(shown, drawing.draw_state(env._now(), env.task))
    env.close()
    assert pygame.display.get_surface() is None


def test_stepping_before_a_reset_is_refused_by_both_kinds():
    for env, action in ((make().unwrapped, 0), (make_vec(2), np.zeros(2, dtype=int))):
        with pytest.raises(gymnasium.error.ResetNeeded):
            env.step(action)


@pytest.mark.parametrize(("limit", "terminated", "truncated"), [(27, False, True), (28, True, False)])
def test_a_limit_of_27_truncates_and_a_collision_at_one_of_28_only_terminates(limit, terminated, truncated):
    env = gymnasium.make("uavnav/Drone-v0", layouts=layouts.generate(1, 0), max_steps=limit)
    env.reset(seed=0)
    *early, last = [env.step(STRAIGHT) for _ in range(limit)]
    assert not any(step[2] or step[3] for step in early)
    assert last[2:4] == (terminated, truncated)
    vector = make_vec(2, layouts=layouts.generate(1, 0), max_steps=limit)
    vector.reset(seed=0)
    *_, last = [vector.step(np.full(2, STRAIGHT)) for _ in range(limit)]
    assert last[2].tolist() == [terminated] * 2
    assert last[3].tolist() == [truncated] * 2


def alike(observation, info, row, alone, alone_info):
    """A row of the batch and an environment by itself: the same place bit for bit, the same sight up to
    rounding.
    """
    np.testing.assert_allclose(observation, alone, rtol=0, atol=1e-5)
    exact = {name: value for name, value in alone_info.items() if name != "clearance"}
    assert {name: info[name][row] for name in exact} == exact
    assert info["clearance"][row] == pytest.approx(alone_info["clearance"], abs=1e-4)


def test_8_rows_of_make_vec_equal_8_single_environments_through_their_autoresets():
    max_steps, picks = 60, np.arange(100, 900, 100)
    vector = make_vec(8, max_steps=max_steps)
    singles = [make(max_steps=max_steps) for _ in picks]
    observation, info = vector.reset(seed=0, options={"layout": picks})
    assert vector.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.SAME_STEP
    for row, (env, pick) in enumerate(zip(singles, picks, strict=True)):
        alone, alone_info = env.reset(seed=0, options={"layout": int(pick)})
        alike(observation[row], info, row, alone, alone_info)
    ends = {"terminated": 0, "truncated": 0}
    for action in random_actions(200, 8, seed=1):
        observation, reward, terminated, truncated, info = vector.step(action)
        assert ("final_obs" in info) == (terminated | truncated).any()
        for row, env in enumerate(singles):
            alone, alone_reward, *alone_ends, alone_info = env.step(action[row])
            assert (reward[row], [terminated[row], truncated[row]]) == (alone_reward, alone_ends)
            if any(alone_ends):
                ends["terminated"], ends["truncated"] = (
                    ends["terminated"] + alone_ends[0],
                    ends["truncated"] + alone_ends[1],
                )
                assert info["_final_obs"][row]
                assert info["_final_info"][row]
                alike(info["final_obs"][row], info["final_info"], row, alone, alone_info)
                assert all(info["final_info"][f"_{name}"][row] for name in alone_info)
                alone, alone_info = env.reset()
            elif "final_obs" in info:
                assert not info["_final_obs"][row]
                assert info["final_obs"][row] is None
            alike(observation[row], info, row, alone, alone_info)
    assert min(ends.values()) > 5


def test_the_vectors_spaces_hold_its_8_observations_and_actions():
    vector = make_vec(8)
    observation, _ = vector.reset(seed=0)
    assert vector.observation_space.contains(observation)
    assert vector.single_observation_space == make().observation_space
    assert vector.action_space == gymnasium.spaces.MultiDiscrete([100] * 8)
    assert vector.num_envs == 8


def test_one_seed_gives_8_rows_places_of_their_own_and_8_seeds_one_each():
    vector = make_vec(8)
    together = vector.reset(seed=4)[1]["layout"]
    assert len(set(together.tolist())) == 8
    assert together.tolist() == vector.reset(seed=4)[1]["layout"].tolist()
    assert together[:3].tolist() == make_vec(3).reset(seed=4)[1]["layout"].tolist()
    assert vector.reset()[1]["layout"].tolist() == ((together + 1) % 1000).tolist()
    each = vector.reset(seed=list(range(8)))[1]["layout"].tolist()
    assert each == [make().reset(seed=seed)[1]["layout"] for seed in range(8)]
    with pytest.raises(ValueError, match="7 seeds for 8"):
        vector.reset(seed=list(range(7)))
    with pytest.raises(ValueError, match="whole numbers of at least 0, or None"):
        vector.reset(seed=[*range(7), -1])
    drawn = [vector.reset(seed=[None, *range(7)])[1]["layout"].tolist() for _ in range(20)]
    assert len({first for first, *_ in drawn}) > 10
    assert {tuple(rest) for _, *rest in drawn} == {tuple(each[:7])}


@pytest.mark.parametrize("seed", [0, 1, 12345])
def test_row_0_of_droneenv_and_both_gymnasium_environments_begin_at_the_same_layout(seed):
    place = uavnav.DroneEnv([4], layouts="test", seeds=seed).state.layout
    assert make().reset(seed=seed)[1]["layout"] == place[0].item()
    assert make_vec(4).reset(seed=seed)[1]["layout"].tolist() == place.tolist()


def test_the_stream_of_headings_follows_the_seed_through_resets_and_autoresets_and_begins_as_droneenvs():
    world = uavnav.World(start_heading="random")
    env, vector = make(world=world), make_vec(4, world=world, max_steps=1)
    task = env.unwrapped.task

    def episodes(seed):
        """Headings of 10 resets of one drone, and of 3 resets and 10 autoresets of four: all after one
        another.
        """
        single = [env.reset(seed=how)[1]["heading"] for how in (seed, *[None] * 9)]
        many = [vector.reset(seed=how)[1]["heading"].tolist() for how in (seed, None, None)]
        many += [vector.step(np.full(4, STRAIGHT))[-1]["heading"].tolist() for _ in range(10)]
        return single, many

    by_seed = {seed: episodes(seed) for seed in range(20)}
    assert all(episodes(seed) == by_seed[seed] for seed in (0, 7))
    assert len({single[0] for single, _ in by_seed.values()}) > 15
    assert len({tuple(single[1:]) for single, _ in by_seed.values()}) == 20
    assert len({tuple(rows) for _, many in by_seed.values() for rows in many}) == 20 * 13
    for seed, (_, many) in by_seed.items():
        assert many[0] == uavnav.DroneEnv([4], task=task, seeds=seed).state.heading.tolist()
    each = vector.reset(seed=[0, 7, 8, 9])[1]["heading"].tolist()
    assert each == [by_seed[seed][0][0] for seed in (0, 7, 8, 9)]


def test_no_array_of_the_first_20_steps_is_changed_by_later_ones():
    vector = make_vec(4, max_steps=9)
    kept = [(vector.reset(seed=0)[0], {})]
    for action in random_actions(20, 4):
        observation, *_, info = vector.step(action)
        kept.append(
            (observation, {name: info[name] for name in ("layout", "x", "y", "heading", "clearance")})
        )
    copies = [
        (observation.copy(), {name: value.copy() for name, value in info.items()})
        for observation, info in kept
    ]
    for action in random_actions(40, 4):
        vector.step(action)
    for (observation, info), (observation_then, info_then) in zip(kept, copies, strict=True):
        np.testing.assert_array_equal(observation, observation_then)
        assert all((info[name] == info_then[name]).all() for name in info)


def test_pictures_are_600_by_800_and_show_the_drone_move():
    env = make(render_mode="rgb_array")
    env.reset(seed=0, options={"layout": 1})
    pictures = [env.render()]
    for action in (STRAIGHT, 50):
        env.step(action)
        pictures.append(env.render())
    env.reset(options={"layout": 2})
    pictures.append(env.render())
    assert all(picture.shape == (600, 800, 3) and picture.dtype == np.uint8 for picture in pictures)
    assert not any((one == other).all() for one, other in itertools.combinations(pictures, 2))


def test_the_picture_has_the_drone_30_px_wide_where_info_says_with_y_upwards():
    env = gymnasium.make("uavnav/Drone-v0", layouts=layouts.generate(1, 0), render_mode="rgb_array")
    env.reset(seed=0)
    for _ in range(10):
        *_, info = env.step(STRAIGHT)
    rows, columns = np.nonzero((env.render() == drawing.DRONE).all(-1))
    assert (columns.min() + columns.max() + 1) / 2 == pytest.approx(info["x"], abs=2)
    assert 600 - (rows.min() + rows.max() + 1) / 2 == pytest.approx(info["y"], abs=2)
    assert (columns.max() - columns.min() + 1) / 2 == pytest.approx(30, abs=2)


def test_the_vector_renders_one_picture_for_each_of_3_rows():
    vector = make_vec(3, render_mode="rgb_array")
    vector.reset(seed=0)
    pictures = vector.render()
    assert [picture.shape for picture in pictures] == [(600, 800, 3)] * 3
    assert not (pictures[0] == pictures[1]).all()


def test_where_an_episode_ends_sb3_is_told_of_that_one_and_of_the_next_in_its_reset_infos():
    pytest.importorskip("stable_baselines3")
    from uavnav.envs.sb3 import DroneVecEnv

    env = DroneVecEnv(2, seed=0, task="goal", layouts="test", max_steps=3)
    env.reset()
    first = [info["layout"] for info in env.reset_infos]
    forward = np.full(2, 3)
    for _ in range(3):
        *_, infos = env.step(forward)
    assert [info["layout"] for info in infos] == first
    assert [info["y"] for info in infos] == [309.0, 309.0]  # three steps of 3 px
    assert [info["succeeded"] for info in infos] == [False, False]
    assert [info["layout"] for info in env.reset_infos] == [layout + 1 for layout in first]
    assert [info["y"] for info in env.reset_infos] == [300.0, 300.0]


def test_layouts_are_chosen_by_sb3s_options_and_methods_are_of_all_rows():
    pytest.importorskip("stable_baselines3")
    from uavnav.envs.sb3 import DroneVecEnv

    env = DroneVecEnv(2, seed=0, layouts="test")
    env.set_options([{"layout": 3}, {"layout": 7}])
    env.reset()
    assert [info["layout"] for info in env.reset_infos] == [3, 7]
    env.reset()  # options are of one reset
    assert [info["layout"] for info in env.reset_infos] != [3, 7]
    env.set_options([{"layout": 3}, {}])
    with pytest.raises(ValueError, match=r"options layout=\[3, None\]; give one for each environment"):
        env.reset()
    assert env.env_method("render") == [None, None]
    with pytest.raises(ValueError, match="indices=0; give none: the 2 environments step together"):
        env.env_method("render", indices=0)


@pytest.mark.parametrize("settings", [{"stack": 2}, {"faults": {"late": 1}}])
def test_whoever_changes_an_observation_in_place_does_not_change_what_the_drone_remembers(settings):
    env, again = (DroneGymEnv("test", **settings) for _ in range(2))
    for one in (env, again):
        one.reset(seed=0)
    for action in (9, 3, 41):
        changed, kept = env.step(action)[0], again.step(action)[0]
        np.testing.assert_array_equal(changed, kept)
        changed *= 0


def test_sb3s_rows_equal_the_vectors_and_name_the_end_of_each_of_their_episodes():
    pytest.importorskip("stable_baselines3")
    from uavnav.envs.sb3 import DroneVecEnv

    env, vector = DroneVecEnv(4, seed=6, layouts="test", max_steps=40), make_vec(4, max_steps=40)
    np.testing.assert_array_equal(env.reset(), vector.reset(seed=6)[0])
    ends = {True: 0, False: 0}
    for action in random_actions(150, 4):
        observation, reward, done, infos = env.step(action)
        expected, earned, terminated, truncated, info = vector.step(action)
        np.testing.assert_array_equal(observation, expected)
        np.testing.assert_array_equal(reward, earned.astype(np.float32))
        np.testing.assert_array_equal(done, terminated | truncated)
        for row in range(4):
            assert ("terminal_observation" in infos[row]) == done[row]
            assert infos[row]["layout"] == (info["final_info"] if done[row] else info)["layout"][row]
            if done[row]:
                assert infos[row]["TimeLimit.truncated"] == truncated[row]
                np.testing.assert_array_equal(infos[row]["terminal_observation"], info["final_obs"][row])
                ends[infos[row]["TimeLimit.truncated"]] += 1
    assert min(ends.values()) > 3


def test_who_writes_into_the_obstacles_that_an_env_shows_changes_neither_it_nor_the_split(all_layouts):
    env = make().unwrapped
    env.reset(options={"layout": 3})
    env.obstacles[:] = 0
    env.velocities[:] = 1
    assert env.obstacles.tolist() == all_layouts[3]
    assert not env.velocities.any()


def test_sb3_is_given_of_3_rows_the_obstacles_velocities_and_spaces_of_the_row_that_it_asks_for():
    pytest.importorskip("stable_baselines3")
    from uavnav.envs.sb3 import DroneVecEnv

    env = DroneVecEnv(3, seed=6, layouts="test", task="moving")
    env.reset()
    for name, shape in (("obstacles", (8, 3)), ("velocities", (8, 2))):
        rows = env.get_attr(name)
        assert [row.shape for row in rows] == [shape] * 3
        np.testing.assert_array_equal(env.get_attr(name, [1])[0], rows[1])
        np.testing.assert_array_equal(env.get_attr(name, 2)[0], rows[2])
        assert not (rows[1] == rows[2]).any()
    assert env.get_attr("observation_space", [0]) == [env.observation_space]
    assert [task.world.speed_max for task in env.get_attr("task")] == [2.0] * 3
