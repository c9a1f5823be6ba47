"""Figures of plain data whose numbers are known, read back from what is drawn."""

import io
import re
import warnings
from urllib.parse import unquote
from xml.etree import ElementTree

import matplotlib
import numpy as np
import pandas as pd
import pytest
from made_up import configuration, episodes
from PIL import Image
from scipy.stats import ttest_1samp

from uavnav import stats, style
from uavnav.colours import OTHERS, PILOTS
from uavnav.report import arena, charts, figures
from uavnav.report.configurations import BINS
from uavnav.runs import paper
from uavnav.tasks.world import World

FRAMES = 1000
WIDTH = FRAMES // BINS
SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(autouse=True)
def _no_warnings():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def texts(figure):
    """Every word on a figure, in legends too."""
    return [text.get_text() for text in figure.findobj(matplotlib.text.Text) if text.get_text()]


def trained(*seeds, algorithm="ppo", activation="tanh"):
    """A configuration from the rewards per frame of each seed, one episode a bin; the bins after the last
    are like it.
    """
    rows = [
        (seed, (place + 1) * WIDTH, WIDTH, WIDTH * reward)
        for seed, rewards in enumerate(seeds)
        for place, reward in enumerate([*rewards, *rewards[-1:] * (BINS - len(rewards))])
    ]
    made = episodes("seed frame steps reward", *rows)
    return configuration(made, (algorithm, activation), n_seeds=len(seeds), frames=FRAMES, n_envs=1)


def drawn(configurations, title=""):
    """Learning curves of configurations by label, with the paper's mean of PPO with tanh."""
    return charts.curves(configurations, {"tanh": 88.527 / 2727.577}, title)


def heights(band):
    """Lowest and highest of a band at each x."""
    vertices = pd.DataFrame(band.get_paths()[0].vertices, columns=["x", "y"]).groupby("x")["y"]
    return vertices.min().tolist(), vertices.max().tolist()


def own_episodes(*paths, seed=0, mode="sampled"):
    """Behaviour of one seed, a path of (x, y) a layout; the last clearance is 20 px: a crash."""
    rows = [
        (seed, layout, step + 1, x, y, 90, 20.0 if step == len(path) - 1 else 60.0, 0, mode)
        for layout, path in enumerate(paths)
        for step, (x, y) in enumerate(path)
    ]
    return pd.DataFrame(
        rows, columns=["seed", "layout", "step", "x", "y", "heading", "clearance", "action", "mode"]
    )


WORLD = World()
LAYOUTS = np.array([[[100.0, 100.0, 50.0], [600.0, 400.0, 80.0]]] * 3)
PATHS = own_episodes([(400.0, 310.0), (400.0, 320.0)], [(400.0, 330.0)], [(410.0, 300.0)] * 5)
EXAMPLES = {
    "curves": lambda: drawn({"tanh": trained([1.0, 2.0], [3.0, 4.0])}),
    "intervals": lambda: charts.intervals({"PPO tanh": np.array([1.0, 2.0])}, {"PPO tanh": 3.0}, "reward"),
    "survival": lambda: charts.survival({"PPO tanh": pd.Series([1.0, 0.5], index=[0.0, 10.0])}, 10),
    "trajectories": lambda: arena.trajectories({"PPO tanh": PATHS}, LAYOUTS, [0, 1], WORLD),
    "heat maps": lambda: arena.heat_maps({"PPO tanh": np.full((3, 4), 1 / 12)}, WORLD),
}
NOTHING = {
    "curves": lambda: drawn({}),
    "curves of no episode": lambda: drawn({"tanh": trained([])}),
    "intervals": lambda: charts.intervals({"PPO tanh": np.array([np.nan])}, {}, "reward"),
    "survival": lambda: charts.survival({}, 10),
    "trajectories": lambda: arena.trajectories({"PPO tanh": PATHS[:0]}, LAYOUTS, [0], WORLD),
    "heat maps": lambda: arena.heat_maps({"PPO tanh": np.zeros((3, 4))}, WORLD),
}


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_figure_is_the_same_bytes_twice_and_8_inches_wide_and_changes_no_settings(name):
    before = dict(matplotlib.rcParams)
    drawn, again = EXAMPLES[name](), EXAMPLES[name]()
    svg, png = drawn.svg, style.png(drawn.figure)
    assert svg == style.Drawn(drawn.figure, "").svg == again.svg
    assert png == style.png(drawn.figure) == style.png(EXAMPLES[name]().figure)  # without an SVG before
    assert int.from_bytes(png[16:20], "big") == 960  # at 120 dots an inch
    assert ElementTree.fromstring(svg).get("width") == "576pt"
    assert not any(word in svg + png for word in (b"Matplotlib", b"dc:date", b"Software"))
    assert dict(matplotlib.rcParams) == before


def scattered():
    figure, axes = style.panel("a: b; c <d> & 'e' M 1 2")
    axes.scatter(range(9), range(9), c=range(9), marker="^", label="a scatter's marks: 9; all")
    axes.legend()
    return figure


@pytest.mark.parametrize("name", [*EXAMPLES, "scatter"])
def test_a_page_holds_of_a_figure_each_word_mark_and_place_to_a_hundredth_of_a_point(name):
    figure = scattered() if name == "scatter" else EXAMPLES[name]().figure
    full, short = (ElementTree.fromstring(text) for text in (style.Drawn(figure, "").svg, by_day(figure)))
    words = [
        [text.strip() for one in tree.iter(f"{SVG}text") for text in one.itertext()] for tree in (full, short)
    ]
    words = [[word for word in of if word] for of in words]
    assert words[0] == words[1]
    for tag in ("path", "use", "text", "image", "clipPath"):
        places = [[places_of(one) for one in tree.iter(f"{SVG}{tag}")] for tree in (full, short)]
        assert [len(one) for one in places[0]] == [len(one) for one in places[1]]
        np.testing.assert_allclose(
            np.concatenate(places[1] or [[]]), np.concatenate(places[0] or [[]]), atol=0.01
        )
    assert styles_of_marks(full) == styles_of_marks(short)
    asked = set(
        re.findall(r"(?:href='#|url\(#)(\w+)", ElementTree.tostring(short).decode().replace('"', "'"))
    )
    assert asked
    assert asked <= {one.get("id") for one in short.iter()}


def by_day(figure):
    """What a page holds of a figure, with its colours by day put in."""
    svg = unquote(style.embedded(style.Drawn(figure, "").svg))
    for place, day in enumerate(style.NIGHT):
        svg = svg.replace(f"var(--{place})", day)
    return svg


def test_every_colour_of_the_pilots_and_of_ink_is_another_by_night():
    svg = unquote(style.embedded(EXAMPLES["survival"]().svg))
    shown = svg.partition("</style>")[2]
    assert re.findall(r"#[0-9a-f]{6}(?=[;'])", shown) == []
    assert f"prefers-color-scheme:dark){{svg{{--0:{style.NIGHT['#000000']};" in svg
    known = {one.lower() for one in (*PILOTS.values(), *OTHERS, style.INK, style.PALE, style.OBSTACLE)}
    assert known <= {*style.NIGHT}
    assert {*style.NIGHT.values()} & known == set()


def places_of(element):
    found = " ".join(element.get(key, "") for key in ("d", "x", "y"))
    return [float(number) for number in re.findall(r"-?\d+(?:\.\d+)?(?:e-?\d+)?", found)]


def styles_of_marks(element, above=""):
    """How each mark is drawn, by its own style or that of its group."""
    mine = element.get("style", above).replace(" ", "")
    own = [mine] if element.tag == f"{SVG}use" else []
    return own + [style for child in element for style in styles_of_marks(child, mine)]


def test_a_figure_with_a_map_keeps_its_colours_and_any_other_has_256_and_white_ground():
    figure, axes = style.panel("a map")
    axes.imshow(np.arange(900).reshape(30, 30))
    kept, few = (Image.open(io.BytesIO(style.png(one))).convert("RGB") for one in (figure, scattered()))
    assert len(kept.getcolors(1 << 20)) > 256 >= len(few.getcolors(1 << 20))
    assert few.getpixel((0, 0)) == (255, 255, 255)


@pytest.mark.parametrize("name", NOTHING)
def test_a_figure_of_nothing_says_no_data(name):
    drawn = NOTHING[name]()
    assert drawn.alt.endswith("no data.")
    assert any("no data" in text for text in texts(drawn.figure))
    assert style.png(drawn.figure).startswith(b"\x89PNG")


def test_a_curve_is_the_mean_of_3_seeds_within_students_interval_and_the_papers_mean_is_dashed():
    shown = drawn({"tanh": trained([0.0, 3.0], [3.0, 3.0], [6.0, 3.0])}, title="PPO: ")
    (axes,) = shown.figure.axes
    line, dashed = axes.lines
    assert line.get_ydata().tolist() == pytest.approx([3.0] * BINS)
    assert line.get_xdata().tolist()[:2] == [20.0, 60.0]  # the middles of the first two 25ths of 1,000 frames
    (band,) = axes.collections
    (first, second, *_), (highest, high, *_) = heights(band)
    low, above = ttest_1samp([0.0, 3.0, 6.0], 0).confidence_interval()
    assert (first, highest) == pytest.approx((low, above))
    assert (second, high) == pytest.approx((3.0, 3.0))
    assert (dashed.get_linestyle(), dashed.get_ydata()) == ("--", [88.527 / 2727.577] * 2)
    assert dashed.get_color() == line.get_color() == style.COLOURS["tanh"]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("frames per seed", "reward per frame")
    assert {"tanh, n = 3", "tanh 0.0325"} <= set(texts(shown.figure))
    assert shown.alt == (
        "PPO: reward per frame in training against frames per seed; in the last bin: "
        "tanh 3.00 (95 % interval 3.00 to 3.00; n = 3; the paper's mean 0.0325)."
    )


@pytest.mark.parametrize("n", [2, 20])
def test_a_band_is_students_interval_of_each_bin(n):
    seeds = np.random.default_rng(1).normal(size=(3, n))
    band = charts.band(pd.DataFrame(seeds))
    low, high = ttest_1samp(seeds, 0, axis=1).confidence_interval()
    assert np.allclose(band[["mean", "low", "high"]], np.stack([seeds.mean(1), low, high], 1))


def test_a_seed_without_a_value_counts_for_none_in_its_bin():
    band = charts.band(pd.DataFrame([[1.0, np.nan, 5.0], [2.0, np.nan, np.inf], [np.nan] * 3]))
    interval = ttest_1samp([1.0, 5.0], 0).confidence_interval()
    assert band.iloc[0].tolist() == pytest.approx([3.0, *interval, 2])
    assert band.iloc[1, 0] == 2.0
    assert band["n"].tolist() == [2, 1, 0]
    assert band.iloc[1:, 1:3].isna().all(axis=None)


def test_the_band_of_2_seeds_is_cut_off_where_the_lines_would_shrink():
    shown = drawn({"tanh": trained([0.0, 3.0], [10.0, 4.0])})
    (axes,) = shown.figure.axes
    (band,) = axes.collections
    assert heights(band)[0][0] < -50
    dashed = 88.527 / 2727.577
    assert axes.get_ylim() == pytest.approx((2 * dashed - 5, 10 - dashed))  # lines from dashed to 5


def test_one_seed_gives_a_line_and_no_band():
    shown = drawn({"tanh": trained([1.0, 2.0])})
    (axes,) = shown.figure.axes
    assert len(axes.collections) == 0
    assert "tanh 2.00 (n = 1; the paper's mean 0.0325)" in shown.alt


def test_a_configuration_without_an_episode_is_said_beside_one_that_has_some():
    shown = drawn({"tanh": trained([]), "relu": trained([1.0])})
    assert "tanh no data; ReLU 1.00 (n = 1)" in shown.alt
    style.png(shown.figure)


def test_two_configurations_of_one_activation_differ_in_their_lines_and_an_unknown_activation_has_a_colour():
    configurations = {"tanh": trained([1.0]), "tanh (lr=1)": trained([2.0]), "mish": trained([3.0])}
    first, dashed, second, third = drawn(configurations).figure.axes[0].lines
    assert (first.get_linestyle(), dashed.get_linestyle(), second.get_linestyle()) == ("-", "--", ":")
    assert first.get_color() == second.get_color() != third.get_color()


def test_five_activations_beyond_the_papers_have_five_looks_of_three_colours():
    looks = style.of_activations(["elu", "gelu", "mish", "silu", "softplus", "tanh"])
    assert len({*looks.values()}) == 6
    assert len({colour for colour, _ in looks.values()}) == 4


def test_an_interval_row_holds_the_mean_of_its_seeds_and_the_papers_value_as_a_diamond():
    seeds = np.array([1.0, 2.0, 3.0, 10.0])
    drawn = charts.intervals({"PPO tanh": seeds}, {"PPO tanh": 7.0}, "speed [px a step]")
    (axes,) = drawn.figure.axes
    found = stats.interval(seeds)
    dots, between, mean, middle, diamond = axes.lines
    assert sorted(dots.get_xdata()) == seeds.tolist()
    assert list(between.get_xdata()) == [found.low, found.high]
    assert list(mean.get_xdata()) == [4.0]
    assert list(middle.get_xdata()) == [2.5]  # the mean of the middle half
    assert (diamond.get_marker(), list(diamond.get_xdata())) == ("D", [7.0])
    assert axes.get_xlabel() == "speed [px a step]"
    assert "tanh, n = 4" in texts(drawn.figure)
    assert drawn.alt.startswith("speed [px a step], mean over seeds: PPO tanh 4.00 (95 % interval ")
    assert drawn.alt.endswith("; n = 4; the paper's 7.00).")


def test_algorithms_share_a_scale_unless_one_would_take_less_than_a_fifth_of_it():
    near = {"PPO tanh": np.array([0.0, 10.0]), "DQN tanh": np.array([4.0, 6.0])}
    far = {"PPO tanh": np.array([0.0, 100.0]), "DQN tanh": np.array([4.0, 6.0])}
    for rows, share in ((near, True), (far, False)):
        first, second = charts.intervals(rows, {}, "reward").figure.axes
        assert (first.get_xlim() == second.get_xlim()) == share
        assert (first.get_title(loc="left") == "PPO") == share


def test_nan_seeds_and_a_single_one_have_no_interval_and_do_not_crash():
    rows = {"PPO tanh": np.array([2.0, np.nan]), "PPO relu": np.array([np.nan]), "PPO sigmoid": np.array([])}
    drawn = charts.intervals(rows, {}, "reward")
    assert (
        drawn.alt == "reward, mean over seeds: PPO tanh 2.00 (n = 1); PPO ReLU no data; PPO sigmoid no data."
    )
    assert not any(line.get_linewidth() == 2.4 for line in drawn.figure.axes[0].lines)


def test_a_ranking_shows_the_seeds_and_cuts_the_wide_intervals_of_two():
    """Two seeds at 10 and 11: their interval, 10.5 ± 6.4, is cut at as far as the seeds are apart."""
    wide, many = np.array([10.0, 11.0]), np.linspace(10.0, 11.0, 40)
    for seeds, limits in ((wide, (9.0, 12.0)), (many, None)):
        found = stats.interval(seeds)
        (axes,) = charts.episodes({"PPO": (seeds, found)}, {"PPO": ("C0", "-")}, np.nan, "reward").figure.axes
        low, high = axes.get_xlim()
        assert low <= 10 < 11 <= high
        assert limits is None or (low, high) == pytest.approx(limits)
    assert (found.low, found.high) > (low, low)  # of forty, nothing is cut
    assert high > found.high


def test_survival_steps_down_where_episodes_end_and_marks_the_limit():
    shares = stats.survival(np.array([10.0, 20.0, 100.0, 100.0]), np.array([True, True, False, False]))
    drawn = charts.survival({"PPO tanh (n = 1)": shares}, limit=100)
    (axes,) = drawn.figure.axes
    line, limit = axes.lines
    assert line.get_xdata().tolist() == [0, 10, 20, 100]
    assert line.get_ydata().tolist() == pytest.approx([1.0, 0.75, 0.5, 0.5])
    assert line.get_drawstyle() == "steps-post"
    assert list(limit.get_xdata()) == [100, 100]
    assert axes.get_xscale() == "log"
    assert "PPO tanh (n = 1)" in texts(drawn.figure)
    assert drawn.alt.endswith("PPO tanh (n = 1) half of them after 20 steps, 50 % open at 100.")


def test_episodes_that_all_stay_up_have_a_flat_line():
    shares = stats.survival(np.array([50.0, 50.0]), np.array([False, False]))
    drawn = charts.survival({"PPO tanh": shares}, limit=50)
    assert set(drawn.figure.axes[0].lines[0].get_ydata()) == {1.0}
    assert "half of them never, 100 % open at 50" in drawn.alt
    style.png(drawn.figure)


def test_a_path_runs_from_the_start_to_its_crash_among_2_obstacles():
    up = PATHS.assign(clearance=60.0)
    drawn = arena.trajectories({"PPO tanh": PATHS, "DQN relu": up}, LAYOUTS, [0, 2], WORLD)
    first, other, _, _ = drawn.figure.axes
    path, start, end = first.lines
    assert np.asarray(path.get_xydata()).tolist() == [[400, 300], [400, 310], [400, 320]]
    assert (list(start.get_xdata()), list(start.get_ydata())) == ([400], [300])
    assert (end.get_marker(), other.lines[2].get_marker()) == ("X", "o")
    assert len(first.collections[0].get_paths()) == 2
    assert first.get_aspect() == 1.0
    assert drawn.alt == (
        "Paths of drones, sampled, and their steps on layouts 0, 2: "
        "PPO tanh, seed 0: 2 crash, 5 crash; DQN ReLU, seed 0: 2 no crash, 5 no crash."
    )


def test_paths_are_of_one_seed_and_mode():
    others = pd.concat([PATHS.assign(seed=2), PATHS.assign(seed=1), PATHS.assign(mode="greedy")])
    drawn = arena.trajectories({"PPO tanh": others, "DQN tanh": others}, LAYOUTS, [0], WORLD)
    assert len(drawn.figure.axes) == 2
    assert len(drawn.figure.axes[0].lines[0].get_xydata()) == 3
    assert drawn.alt.count("seed 1: 2 crash") == 2


def test_heat_maps_share_a_scale_up_to_the_largest_share_and_lie_the_right_way_up():
    one, other = np.full((3, 4), 1 / 12), np.zeros((3, 4))
    other[0, 0] = 1.0
    drawn = arena.heat_maps({"PPO tanh": one, "DQN tanh": other}, WORLD)
    images = [axes.images[0] for axes in drawn.figure.axes[:2]]
    assert [image.get_clim() for image in images] == [(0, 1.0)] * 2
    assert (images[1].origin, tuple(images[1].get_extent())) == ("lower", (0, 800, 0, 600))
    assert any("share of steps in 200 x 200 px" in text for text in texts(drawn.figure))
    assert drawn.alt.endswith("PPO tanh 50 %, DQN tanh 8 %.")


def test_the_papers_means_of_dqn_are_named_at_the_right_end_a_line_of_words_apart():
    means = {one: paper.printed("dqn", one, "reward", per_frame=True) for one in paper.ACTIVATIONS}
    (axes,) = charts.curves({one: trained([0.0], [1.0]) for one in means}, means).figure.axes
    named = {text.get_text(): text.xyann for text in axes.texts}
    assert set(named) == {"tanh -0.0438", "sigmoid -0.0268", "ReLU -0.037", "leaky ReLU -0.0353"}
    heights = sorted(place for _, place in named.values())
    assert np.diff(heights).min() > 0.054
    assert {place for place, _ in named.values()} == {1.06}


def test_the_figure_of_test_episodes_shows_the_means_and_intervals_of_the_table_of_gaps():
    gaps = pd.DataFrame(
        [
            ("PPO tanh", "sampled", 10_000, 2, 4.0, -1.5, 9.5),
            ("PPO relu", "greedy", 10_000, 2, 9.0, 8.0, 10.0),
        ],
        columns=["who", "mode", "limit", "n", "reward", "low", "high"],
    )
    figure = figures._tested({"PPO tanh": np.array([3.0, 5.0])}, gaps)
    assert figure.drawn.alt == "reward per test episode: PPO tanh 4.00 (95 % interval -1.50 to 9.50; n = 2)."
    assert "after 10,000 steps" in figure.caption


def test_the_scripted_policy_is_a_dashed_line_beside_configurations_and_without_one_there_is_no_line():
    rows = {"PPO tanh": np.array([1.0, 2.0]), "DQN tanh": np.array([0.0, 1.0])}
    drawn = charts.intervals(rows, {}, "reward", 428.0)
    for axes in drawn.figure.axes:
        assert [line.get_xdata()[0] for line in axes.lines if line.get_linestyle() == "--"] == [428.0]
    assert drawn.alt.endswith("; scripted policy 428.0.")
    assert "the paper" not in texts(drawn.figure)  # of which there is no number
    assert style.SCRIPTED_NAME in texts(drawn.figure)
    assert style.SCRIPTED_NAME not in texts(charts.intervals(rows, {}, "reward").figure)
    up = pd.Series([1.0, 1.0], index=[0.0, 100.0])
    (axes,) = charts.survival(
        {"PPO tanh": pd.Series([1.0, 0.5], index=[0.0, 10.0]), style.SCRIPTED_NAME: up}, 100
    ).figure.axes
    mine, scripted, _ = axes.lines
    assert (mine.get_linestyle(), scripted.get_linestyle(), scripted.get_label()) == (
        "-",
        "--",
        style.SCRIPTED_NAME,
    )
    assert scripted.get_ydata().tolist() == [1.0, 1.0]
