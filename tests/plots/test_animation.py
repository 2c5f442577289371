"""The animation: whole files that play in real time and show what the loop did."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from hybrid_mpc import InputError, Signal
from hybrid_mpc.plots import animation
from hybrid_mpc.plots.animation import GHOSTS, Scene, animate
from scenarios.golf_robot.drawing import draw

PLANNED = np.array([213, 94, 0])  # the colour of all that is planned (#D55E00)


def swing(n=151, dt=0.02, horizon=50):
    """A swinging club whose plans come true: (t, x, plans, u)."""
    t = dt * np.arange(n)
    ahead = t[:, None] + dt * np.arange(horizon + 1)

    def state(time):
        return np.stack([0.6 * np.sin(4 * time), 2.4 * np.cos(4 * time)], axis=-1)

    return t, state(t), state(ahead), 0.5 * np.sign(np.sin(3 * t))[:, None]


def write(path, t, x, plans, u, **more):
    labels = {
        "curves": [(0, Signal("phi", "rad"))],
        "inputs": (Signal("u", "N m"),),
        "limits": ((-0.5,), (0.5,)),
    }
    options = {"dt": 0.02, "draw": draw, "title": "A swing"} | labels | more
    return animate(path, t, x, plans, u=u, **options)


def frames(path):
    with Image.open(path) as film:
        pictures, durations = [], []
        for k in range(film.n_frames):
            film.seek(k)
            pictures.append(np.asarray(film.convert("RGB")).astype(int))
            durations.append(film.info["duration"])
    return np.array(pictures), durations


def planned_pixels(picture):
    return int(np.sum(np.abs(picture - PLANNED).sum(axis=-1) < 60))


@pytest.mark.full
def test_three_seconds_are_small_and_play_in_real_time(tmp_path):
    path = write(tmp_path / "films" / "a.gif", *swing())
    assert path.stat().st_size < 2e6  # what a web page bears
    pictures, durations = frames(path)
    assert len(pictures) == 76  # 25 a second from 0 to 3 s, both ends
    # Frames last until the next sample shown, the last one LAST: GIF's hundredths sum up exactly.
    assert sum(durations) == 1000 * 3.0 + 1000 * animation.LAST
    assert np.all(pictures[:, 2, 2] == 255)  # the paper is white in every frame
    assert [p.name for p in path.parent.iterdir()] == ["a.gif"]


@pytest.mark.full
def test_an_odd_period_does_not_drift_from_real_time(tmp_path):
    t, x, plans, u = swing(n=60, dt=0.033)
    _, durations = frames(write(tmp_path / "a.gif", t, x, plans, u, dt=0.033))
    assert abs(sum(durations) - 1000 * (59 * 0.033 + animation.LAST)) <= 10  # one hundredth, rounded once


def test_a_long_loop_has_fewer_frames_a_second():
    shown = animation._frames(0.02 * np.arange(3001))
    assert shown[0] == 0
    assert shown[-1] == 3000
    assert len(shown) <= animation.MOST_FRAMES + 1  # and the last sample
    assert animation._frames(0.1 * np.arange(11)) == list(range(11))  # never more than one a sample
    assert animation._frames(np.array([0.0])) == [0]


def test_the_plan_is_drawn_where_there_is_one(tmp_path):
    t, x, plans, u = swing(n=7, dt=0.04)
    plans[2:] = np.nan
    plans[4, :11] = swing()[2][4, :11]  # the beginning of a plan is drawn, too
    pictures, _ = frames(write(tmp_path / "a.gif", t, x, plans, u, dt=0.04))
    with_plan = [planned_pixels(picture) for picture in pictures]
    # Frames without a plan keep the legend's dashes in that colour and nothing more.
    legend = with_plan[2]
    assert with_plan[3] == with_plan[5] == legend
    assert min(with_plan[0], with_plan[1], with_plan[4]) > legend + 50


def test_ghosts_fade_into_the_future(tmp_path):
    t, x, plans, u = swing(n=2)

    def cart(state):
        corners = np.array([[-0.02, 0.0], [0.02, 0.0], [0.02, 0.1], [-0.02, 0.0]])
        return [corners + np.array([state[0], 0.0])]

    plans = np.linspace([0.0, 0.0], [1.0, 0.0], 51)[None].repeat(2, axis=0)
    x = plans[:, 0] + [[0.0, 0.0], [1.0, 0.0]]
    scene = Scene(
        animation._checked(tmp_path / "a.gif", t, x, plans, 0.02, cart, u), "", [(0, Signal("q", "m"))],
        (Signal("F", "N"),), None,
    )  # fmt: skip
    scene._set(0)
    places = [group[0][1].get_xy()[0, 0] for group in scene._ghosts]
    shades = [group[0][1].get_alpha() for group in scene._ghosts]
    assert places == sorted(places, reverse=True)  # the farthest is drawn first ...
    assert shades == sorted(shades)  # ... and the faintest
    assert places[0] == pytest.approx(0.98)  # the end of the horizon: its cart's left corner
    assert len(set(places)) == GHOSTS


def test_axes_carry_units_and_the_legend_is_complete(tmp_path):
    t, x, plans, u = swing(n=3)
    loop = animation._checked(tmp_path / "a.gif", t, x, plans, 0.02, draw, u)
    scene = Scene(loop, "A $1 swing", [(0, Signal("phi", "rad"))], (Signal("u", "N m"),), ((-0.5,), (0.5,)))
    figure = scene._figure
    labels = [ax.get_ylabel() for ax in figure.axes] + [
        figure.axes[0].get_xlabel(),
        figure.axes[-1].get_xlabel(),
    ]
    assert all(label.endswith("]") for label in labels)
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["true motion", "planned motion", "input limits", "input"]


def test_a_fault_and_the_alarm_are_said_from_their_instant_on(tmp_path):
    t, x, plans, u = swing(n=6)
    loop = replace(
        animation._checked(tmp_path / "a.gif", t, x, plans, 0.02, draw, u),
        alarm=np.array([False, False, False, True, True, False]), events=((0.04, "friction doubles"),),
    )  # fmt: skip
    scene = Scene(loop, "A swing", [(0, Signal("phi", "rad"))], (Signal("u", "N m"),), None)
    said = []
    for k in range(6):
        scene._set(k)
        said.append(scene._said.get_text())
    told = "friction doubles"
    assert said == ["", "", told, f"{told}\nALARM", f"{told}\nALARM", told]
    drawn = [bar.get_xydata() for bar in scene._bars]
    assert len(drawn) == 2  # a bar over the curve and one over the input
    for bar in drawn:
        assert np.isfinite(bar[:, 1]).tolist() == loop.alarm.tolist()
    assert [len(ax.lines) for ax in scene._figure.axes[1:]] == [5, 3]  # with the fault's line and the bar
    assert "monitor alarms" in [text.get_text() for text in scene._figure.legends[0].get_texts()]


def test_an_alarm_of_another_length_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"alarm.*HM-PLOTS-032"):
        write(tmp_path / "a.gif", *swing(n=5), alarm=np.zeros(4))


def test_a_plan_that_runs_away_does_not_flatten_the_motion(tmp_path):
    t, x, plans, u = swing(n=5)
    plans[3] *= 1e6
    loop = animation._checked(tmp_path / "a.gif", t, x, plans, 0.02, draw, u)
    scene = Scene(loop, "", [(0, Signal("phi", "rad"))], (Signal("u", "N m"),), None)
    low, high = scene._figure.axes[1].get_ylim()
    span = np.ptp(x[:, 0])
    assert high - low <= 1.8 * 1.12 * span + 1e-9  # 0.4 of the motion to either side, 6 % margin each


def test_a_loop_that_stands_still_and_a_single_sample_are_drawn(tmp_path):
    t, x, plans, u = swing(n=3, horizon=2)
    pictures, _ = frames(
        write(tmp_path / "a.gif", t, 0 * x, np.nan * plans, np.nan * u, limits=((-np.inf,), (1.0,)))
    )
    assert np.any(pictures[0] < 100)
    assert write(tmp_path / "b.gif", t[:1], x[:1], plans[:1], u[:1]).exists()


def test_same_loop_same_bytes_and_a_failure_keeps_the_old_file(tmp_path):
    loop = swing(n=5)
    files = [write(tmp_path / f"{i}.gif", *loop) for i in range(2)]
    first, second = (hashlib.sha256(f.read_bytes()).hexdigest() for f in files)
    assert first == second
    with pytest.raises(ValueError, match="no picture"):
        write(files[0], *loop, draw=broken_from(0.05))
    assert hashlib.sha256(files[0].read_bytes()).hexdigest() == first
    assert sorted(p.name for p in tmp_path.iterdir()) == ["0.gif", "1.gif"]


def broken_from(angle):
    def drawing(x):
        if x[0] > angle:
            raise ValueError("no picture")
        return draw(x)

    return drawing


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a | {"path": "a.png"}, r"\.gif"),
        (lambda a: a | {"dt": 0.0}, "HM-PLOTS-011"),
        (lambda a: a | {"plans": a["plans"][:-1]}, "plans"),
        (lambda a: a | {"plans": a["plans"][:, :, :1]}, "plans"),
        (lambda a: a | {"t": a["t"][::-1]}, "increase"),
        (lambda a: a | {"x": np.nan * a["x"]}, "finite"),
        (lambda a: a | {"inputs": ()}, "inputs"),
        (lambda a: a | {"limits": ((), ())}, "limits"),
        (lambda a: a | {"draw": lambda x: draw(x)[: 5 + (x[0] > 0.1)]}, "HM-PLOTS-016"),
    ],
)
def test_bad_input_is_refused(change, message, tmp_path):
    t, x, plans, u = swing(n=4)
    a = change({"path": "a.gif", "t": t, "x": x, "plans": plans, "u": u})
    with pytest.raises(InputError, match=message):
        write(tmp_path / a.pop("path"), **a)
    assert not list(tmp_path.iterdir())


def test_the_club_hangs_at_zero_and_swings_right_when_positive():
    shaft, head, pivot, ball, tee, floor = draw(np.zeros(2))
    np.testing.assert_allclose(shaft, [[0.0, 0.0], [0.0, -0.7]])
    assert draw(np.array([0.5]))[0][-1, 0] > 0
    assert np.ptp(floor[:, 1]) == 0
    assert floor[0, 1] < head[:, 1].min()  # the club passes above the floor
    np.testing.assert_allclose(head[:, 0].max(), ball[:, 0].min(), atol=1e-3)  # touching; a polygon's corner
    assert tee[-1, 1] == floor[0, 1]
    for closed in (head, pivot, ball):
        np.testing.assert_array_equal(closed[0], closed[-1])
    for angle in np.linspace(-np.pi, np.pi, 9):  # a rigid body: distances from the axis stay (to rounding)
        turned = draw(np.array([angle]))
        for a, b in zip((shaft, head), turned[:2], strict=True):
            np.testing.assert_allclose(np.hypot(*b.T), np.hypot(*a.T), atol=1e-12)
        for a, b in zip((pivot, ball, tee, floor), turned[2:], strict=True):
            np.testing.assert_array_equal(a, b)
    with pytest.raises(InputError, match="HM-SCENARIOS-005"):
        draw(np.array([np.nan]))


def test_every_state_that_is_asked_for_has_a_curve_in_its_unit(tmp_path):
    t, x, plans, u = swing(n=5)
    loop = animation._checked(tmp_path / "a.gif", t, x, plans, 0.02, draw, np.hstack([u, 2 * u]))
    curves = [(1, Signal("phi_dot", "rad/s")), (0, Signal("phi", "rad"))]
    scene = Scene(loop, "", curves, (Signal("u", "N m"), Signal("valve", "%")), None)
    scene._set(4)
    labels = [ax.get_ylabel() for ax in scene._figure.axes[1:]]
    assert labels == [r"$\dot{\varphi}$ [rad/s]", r"$\varphi$ [rad]", "u [N m]", "valve [%]"]
    np.testing.assert_array_equal(scene._curves[0][0].get_ydata(), x[:, 1])
    np.testing.assert_array_equal(scene._curves[1][1].get_ydata(), plans[4, :, 0])
    assert write(tmp_path / "b.gif", t, x, plans, u, curves=None).exists()
    with pytest.raises(InputError, match="HM-PLOTS-013"):
        write(tmp_path / "c.gif", t, x, plans, u, curves=[(2, Signal("q", "m"))])
