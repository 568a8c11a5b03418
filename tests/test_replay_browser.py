"""Tracks, marks, evidence and choice in headless Chromium: what is shown at the cursor is what the library computes."""

# ruff: noqa: F811  fixtures of another file are arguments here

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_playback_browser import opened, wait_until  # noqa: F401
from test_replay_tracks import START, TARGET, drawer, rollout  # noqa: F401

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import FrameJacobian
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks import FreeDirection
from manip_learn.playback import RecordingChoice, replay
from manip_learn.recordings.trajectory import Trajectory

pytestmark = pytest.mark.browser
BETWEEN = [0.0, 0.1, 0.105, 0.4637, 0.73, 0.999, 1.0]  # at key frames, at other samples, between samples


def library_values(robot, constraint, rollout, t) -> dict[str, dict[str, float]]:
    """Track -> curve -> value at time t, straight between the samples."""
    at = lambda values: float(np.interp(t, rollout.time, values))  # noqa: E731
    sigma = np.array([np.linalg.svd(constraint(q), compute_uv=False) for q in rollout.q])
    span = robot.position_upper - robot.position_lower
    names = robot.joint_names
    return {
        "singular": {f"σ{k + 1}": at(sigma[:, k]) for k in range(sigma.shape[1])},
        "velocity": {n: at(rollout.u[:, i] / robot.velocity_limit[i]) for i, n in enumerate(names)},
        "position": {n: at((rollout.q[:, i] - robot.position_lower[i]) / span[i]) for i, n in enumerate(names)},
        "task-error": {"": at(rollout.task_error)},
        "following-error": {"": at(rollout.following_error)},
    }


def test_values_at_the_cursor_are_the_librarys(robot_of, drawer, rollout, tmp_path, opened):
    """At key frames, at samples and between them, for every curve of every track."""
    robot = robot_of("sawyer")
    slipping = replace(rollout, following_error=np.linspace(0.0, 0.02, len(rollout)) ** 2)
    page = opened(replay(robot, {"a": slipping}, tmp_path / "a.html").html.as_uri())
    for t in BETWEEN:
        shown = page.evaluate("t => manipLearn.trackValues(t)", t)
        expected = library_values(robot, drawer, slipping, t)
        assert shown.keys() == expected.keys()
        for kind, curves in expected.items():
            assert shown[kind]["a"] == pytest.approx(curves, rel=1e-5, abs=1e-6), f"{kind} at {t} s"


def test_marks_are_the_librarys(robot_of, drawer, rollout, tmp_path, opened):
    """Directions held and free, and the ellipsoid: its semi-axes are the singular values of A, between samples too."""
    robot = robot_of("sawyer")
    page = opened(replay(robot, {"a": rollout}, tmp_path / "a.html").html.as_uri())
    for t in BETWEEN:
        page.evaluate("t => manipLearn.seek(t)", t)
        marks = page.evaluate("t => manipLearn.marks('a', t)", t)
        i = int(np.searchsorted(rollout.time, t + 1e-9) - 1)
        j = min(i + 1, len(rollout) - 1)
        share = 0.0 if i == j else (t - rollout.time[i]) / (rollout.time[j] - rollout.time[i])
        M = sum(
            w * drawer.selection.T @ drawer(rollout.q[k]) @ drawer(rollout.q[k]).T @ drawer.selection
            for k, w in ((i, 1.0 - share), (j, share))
        )
        lengths = [axis["length"] for axis in marks["ellipsoid"]]
        np.testing.assert_allclose(lengths, np.sqrt(np.maximum(np.linalg.eigvalsh(M)[::-1], 0.0)), atol=2e-4)
        if share < 1e-9:
            sigma = np.linalg.svd(drawer(rollout.q[i]), compute_uv=False)
            np.testing.assert_allclose(lengths[:2], sigma, atol=1e-5)
        held = np.array(marks["held"])
        np.testing.assert_allclose(held @ held.T, np.eye(2), atol=1e-6)
        np.testing.assert_allclose(held.T @ held, drawer.selection.T @ drawer.selection, atol=1e-6)
        (free,) = np.array(marks["free"])
        np.testing.assert_allclose(drawer.selection @ free, 0.0, atol=1e-6)


def test_marks_of_the_hands_own_axes_turn_with_it(robot_of, drawer, rollout, tmp_path, opened):
    """Rows along the hand's axes are drawn in them, at the tip, where kinematics puts both."""
    robot = robot_of("sawyer")
    local = Constraint(drawer.selection, FrameJacobian(robot, "right_gripper_tip", "xyz", "local"))
    page = opened(replay(robot, {"a": rollout}, tmp_path / "a.html", constraint=local).html.as_uri())
    for i in (0, 60, 100):
        page.evaluate("t => manipLearn.seek(t)", float(rollout.time[i]))
        pose = np.array(page.evaluate("manipLearn.marks('a', manipLearn.time).pose")).reshape(4, 4)
        np.testing.assert_allclose(pose, robot.pose(rollout.q[i], local.features.frame), atol=1e-6)


def test_tracks_are_switched_and_share_the_cursor(robot_of, rollout, tmp_path, opened):
    """At first none is drawn; each box adds one, with its values; a click in it moves time; all cursors agree."""
    page = opened(replay(robot_of("sawyer"), {"a": rollout}, tmp_path / "a.html").html.as_uri())
    assert page.locator("#tracks .track").count() == 0
    page.locator("#track-choice summary").click()
    for kind in ("singular", "velocity"):
        page.locator(f"[data-track={kind}]").check()
    page.locator("#track-choice summary").click()
    assert page.locator("#tracks figcaption b").all_inner_texts() == [
        "Singular values of A",
        "Joint velocities over their limits",
    ]
    box = page.locator("#tracks .curves").first.bounding_box()
    left, right = box["x"] + 58, box["x"] + box["width"] - 14
    page.mouse.click(left + 0.6 * (right - left), box["y"] + 30)
    t = page.evaluate("manipLearn.time")
    assert t == pytest.approx(0.6, abs=0.01)
    cursors = page.locator("#tracks .cursor, #chart line[stroke-width='1.5']").evaluate_all(
        "lines => lines.map((line) => Number(line.getAttribute('x1')))"
    )
    assert len(cursors) == 3 and max(cursors) - min(cursors) < 1e-6
    sigma = page.evaluate("manipLearn.trackValues(manipLearn.time).singular.a")["σ1"]
    assert float(page.locator("#tracks .value span").first.inner_text()) == pytest.approx(sigma, rel=1e-2)
    page.locator("#track-choice summary").click()
    page.locator("[data-track=first]").uncheck()
    assert not page.locator("#chart").is_visible() and page.locator("#tracks .track").count() == 2
    page.keyboard.press("Escape")
    assert not page.locator("#track-choice section").is_visible()


def recordings_page(robot, constraint, rollout, path, command=()):
    """Three recordings, the last of which breaks the constraint and is odd."""
    wrong = rollout.u + 0.5 * np.linalg.pinv(constraint(rollout.q[0]))[:, 0]
    demos = {"a": rollout.u, "b": rollout.u, "c": wrong}
    named = {n: Trajectory(rollout.time, rollout.q, u, robot.joint_names, n) for n, u in demos.items()}
    choice = RecordingChoice(command, {"a": 0, "b": 1, "c": 2}) if command else None
    report = {"sentence": "moves freely along x", "gap": 12.0, "odd_trajectories": [["c", "moves 3 mm"]]}
    phases = [(n, 0.2, 0.8, 0) for n in named]
    return replay(robot, named, path, constraint=constraint, report=report, phases=phases, choice=choice).html.as_uri()


def test_recordings_are_left_out_with_their_command(robot_of, drawer, rollout, tmp_path, opened):
    """The box hides a recording and changes the command line; odd ones are marked and left out by one button."""
    robot = robot_of("sawyer")
    page = opened(recordings_page(robot, drawer, rollout, tmp_path / "a.html", ("manip-learn", "learn", "a b")))
    assert page.locator("#legend .name").all_inner_texts() == ["a", "b", "c odd"]
    page.locator("#choice summary").click()
    command = page.locator("#choice code")
    assert command.inner_text() == "manip-learn learn 'a b' --episodes 0:3"
    page.locator("[data-recording=b]").uncheck()
    assert command.inner_text() == "manip-learn learn 'a b' --episodes 0,2"
    assert page.locator("#legend .eye").nth(1).get_attribute("aria-pressed") == "false"
    page.get_by_role("button", name="Without the odd ones").click()
    assert command.inner_text() == "manip-learn learn 'a b' --episodes 0:2"
    page.get_by_role("button", name="None").click()
    assert "at least one" in command.inner_text() and page.locator("#choice .command button").is_disabled()
    page.get_by_role("button", name="All").click()
    page.locator("#choice .command button").click()
    wait_until(page, "document.querySelector('#choice .said').textContent.includes('cop')")
    assert "moves 3 mm" in page.locator("#choice .odd").inner_text()


def test_without_a_command_line_the_choice_is_python(robot_of, drawer, rollout, tmp_path, opened):
    """A page written from Python says how to leave recordings out there."""
    page = opened(recordings_page(robot_of("sawyer"), drawer, rollout, tmp_path / "a.html"))
    page.locator("#choice summary").click()
    page.locator("[data-recording=b]").uncheck()
    expected = 'ml.Demonstrations([d for d in demos if d.name not in {"b"}])'
    assert page.locator("#choice code").inner_text() == expected


def test_colours_of_the_fit(robot_of, drawer, rollout, tmp_path, opened):
    """Bands and key change to the fit and back; what breaks the constraint has another colour than what fits."""
    page = opened(recordings_page(robot_of("sawyer"), drawer, rollout, tmp_path / "a.html"))
    rows = page.locator("#chart .bands")
    before, key = rows.nth(2).inner_html(), page.locator("#status-key").inner_text()
    page.locator("#shown summary").click()
    page.locator("[name=colours][value=fit]").check()
    assert "100 %" in page.locator("#status-key").inner_text()
    middle = "bands => { const bars = [...bands.querySelectorAll('rect')]; return bars[bars.length >> 1]; }"
    titles = [rows.nth(k).evaluate(f"bands => ({middle})(bands).textContent") for k in range(3)]
    shares = page.evaluate("manipLearn.trackValues(0.5).fit")
    for name, title in zip("abc", titles, strict=True):
        assert float(title.split(": ")[1].split(" %")[0]) == pytest.approx(100.0 * shares[name]["share"], abs=1.0)
    page.locator("[name=colours][value=phase]").check()
    assert rows.nth(2).inner_html() == before and page.locator("#status-key").inner_text() == key


def test_marks_and_evidence_are_switched(robot_of, drawer, rollout, tmp_path, opened):
    """Each element of the scene has a box that changes the picture; the evidence is told in words; one card is open."""
    robot = robot_of("sawyer")
    kept = Constraint(drawer.selection, drawer.features, {"sentence": "moves freely along x", "gap": 12.0})
    page = opened(replay(robot, {"a": rollout}, tmp_path / "a.html", constraint=kept).html.as_uri())
    page.evaluate("manipLearn.seek(0.5)")

    def picture():
        page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        return page.locator("#scene canvas").screenshot(style="#legend, #notes, .sheet { visibility: hidden }")

    page.locator("#shown summary").click()
    names = page.locator("[data-shown]").evaluate_all("boxes => boxes.map((box) => [box.dataset.shown, box.checked])")
    assert names == [["constraint", True], ["target", True], ["ellipsoid", True], ["paths", True], ["labels", True]]
    for name, _ in names[:-1]:
        before = picture()
        page.locator(f"[data-shown={name}]").click()
        assert picture() != before, name
    assert "drawn for 1 m/s" in page.locator("#shown .key").inner_text()
    page.locator("#evidence summary").click()
    wait_until(page, "!document.querySelector('#shown').open", 5.0)
    told = page.locator("#evidence section").inner_text()
    assert "moves freely along x" in told and "12" in told and "10 and above is clear" in told


@pytest.mark.parametrize("width", [320, 390, 1000])
def test_cards_and_tracks_stay_within_the_window(robot_of, drawer, rollout, tmp_path, opened, width):
    """No card and no track is wider than the window, at the width of a phone either."""
    page = opened(recordings_page(robot_of("sawyer"), drawer, rollout, tmp_path / "a.html"), width, 700)
    for name in ("track-choice", "shown", "evidence", "choice"):
        page.locator(f"#{name} summary").click()
        box = page.locator(f"#{name} section").bounding_box()
        assert box["x"] >= 0.0 and box["x"] + box["width"] <= width, name
        if name == "track-choice":
            for track in page.locator("[data-track]").all():
                track.check()
        page.locator(f"#{name} summary").click()
    assert page.locator("#tracks").bounding_box()["width"] <= width


@pytest.fixture(scope="module")
def opening(drawer):
    """Two rollouts that pull the drawer by 15 and by 8 cm, whose constraint keeps its mechanism."""
    line = {"type": "line", "axis": [0.91, 0.42, 0.0], "point": [0.0, 0.0, 0.9], "sentence": "a line"}
    kept = Constraint(drawer.selection, drawer.features, {"n_constraints": 2, "mechanism": line})
    tasks = {"far": FreeDirection(kept, -0.15, 0.4), "near": FreeDirection(kept, -0.08, 0.4)}
    robot = drawer.features.robot
    return {n: simulate(robot, ResolvedRateController(kept, task), START, 1.2, 0.01) for n, task in tasks.items()}


def test_the_drawer_is_in_the_hand_and_says_how_far_it_is_open(robot_of, opening, tmp_path, opened):
    """At any time, of whichever rollout is solid; the label and the legend say the opening that the curve has."""
    robot = robot_of("sawyer")
    page = opened(replay(robot, opening, tmp_path / "a.html").html.as_uri())
    for k, name in enumerate(opening):
        page.locator("#legend .pick").nth(k).click()
        for i in (0, 50, 120):
            t = float(opening[name].time[i])
            page.evaluate("t => manipLearn.seek(t)", t)
            handle = page.evaluate("name => manipLearn.handle(name)", name)
            tip = robot.pose(opening[name].q[i], robot.frame("right_gripper_tip"))[:3, 3]
            np.testing.assert_allclose(handle, tip, atol=1e-3)
            value = page.evaluate("([t, name]) => manipLearn.trackValues(t).opening[name]['']", [t, name])
            wait_until(page, f"document.getElementById('labels').textContent.includes('drawer {value:.3f} m open')")
            assert f"{value:.3f} m open" in page.locator("#legend .state").nth(k).inner_text()
        assert value == pytest.approx({"far": 0.15, "near": 0.08}[name], abs=2e-3)
    words = {"free to move", "held", "target", "line that was learnt", "speed within reach (μ)"}
    assert words <= set(page.locator("#labels span:visible").all_inner_texts())
    page.locator("#shown summary").click()
    for name in ("furniture", "labels"):
        page.locator(f"[data-shown={name}]").uncheck()
    wait_until(page, "document.querySelectorAll('#labels span:not([hidden])').length === 0")


@pytest.fixture(scope="module")
def plan(opening):
    """A hand that leaves the handle, comes back, takes hold, and goes the far way; its phases are those of a plan."""
    way, time = opening["far"], np.arange(101) * 0.01
    aside = np.outer(np.sin(np.pi * time) ** 2, [0.3, 0.4, 0.0, -0.3, 0.0, 0.2, 0.0])
    curves = {"manipulability": 0.0 * time + 0.05, "task_error": 0.0 * time, "status": ("ok",) * 101}
    approach = replace(way, time=time, q=START + aside, u=0.0 * aside, phases=(("approach", 0.0, 1.0),), **curves)
    return approach.followed_by(replace(way, phases=(("hold", 0.0, 0.1), ("way", 0.1, 1.2))))


def test_a_plan_beside_other_rollouts(robot_of, opening, plan, tmp_path, opened):
    """Its band has the words, its drawer is shut until the way begins, and the others are drawn as without it."""
    robot = robot_of("sawyer")
    page = opened(replay(robot, {"plan": plan, **opening}, tmp_path / "a.html").html.as_uri(), 1280, 800)
    assert page.locator("#chart .bands text:not(.mark)").all_text_contents() == ["planplan"]  # with its title
    assert page.locator("#chart .bands .mark").all_text_contents() == ["approach", "hold", "way"]
    for t, phase, shut in ((0.0, "approach", True), (0.5, "approach", True), (1.05, "hold", True), (2.2, "way", False)):
        page.evaluate("t => manipLearn.seek(t)", t)
        assert page.locator("#phase").inner_text() == f"plan: {phase}"
        assert page.locator("#chart .readout text").all_text_contents()[1].endswith(f" {phase}")
        states = page.locator("#legend .state").all_inner_texts()
        assert [phase in state for state in states] == [True, False, False]
        assert ("0.000 m open" in states[0]) == shut
        marks = page.locator("#labels span:visible").all_inner_texts()
        assert ("held" in marks) == (phase != "approach")
    begins = robot.pose(plan.q[110], robot.frame("right_gripper_tip"))[:3, 3]
    page.evaluate("manipLearn.seek(0.5)")
    np.testing.assert_allclose(page.evaluate("manipLearn.handle('plan')"), begins, atol=1e-3)
    np.testing.assert_allclose(page.evaluate("manipLearn.trackValues(2.2).opening.plan['']"), 0.15, atol=4e-3)
    colours = page.locator("#legend .rollout").evaluate_all("all => all.map(e => e.style.getPropertyValue('--colour'))")
    assert len(set(colours)) == 3


def test_first_view_and_tracks_leave_the_scene_its_half(robot_of, opening, tmp_path, opened):
    """Every mark is in the first view, and the scene has half the window, with all tracks open too."""
    page = opened(replay(robot_of("sawyer"), opening, tmp_path / "a.html").html.as_uri(), 1280, 800)
    for t in (0.0, 1.2):
        page.evaluate("t => manipLearn.seek(t)", t)
        wait_until(page, "document.querySelectorAll('#labels span:not([hidden])').length === 6")
    page.locator("#track-choice summary").click()
    for box in page.locator("[data-track]").all():
        box.check()
    assert page.locator("#scene").bounding_box()["height"] >= 400.0
    assert page.locator("#tracks .track").count() > 3 and page.locator("#transport").bounding_box()["y"] < 760.0


def test_the_readout_has_the_values_at_the_cursor(robot_of, opening, tmp_path, opened):
    """Beside the cursor stand its time and each curve's value; over the curves, those under the mouse."""
    page = opened(replay(robot_of("sawyer"), opening, tmp_path / "a.html").html.as_uri())
    texts = page.locator("#chart .readout text")

    def values(i):
        return [float(f"{r.manipulability[i]:.3g}") for r in opening.values()]

    page.evaluate("manipLearn.seek(0.5)")
    assert texts.first.text_content() == "0.50 s"
    assert [float(text) for text in texts.all_text_contents()[1:]] == values(50)
    box = page.locator("#chart").bounding_box()
    page.mouse.move(box["x"] + box["width"] - 14, box["y"] + 40)
    assert texts.first.text_content() == "1.20 s" and page.evaluate("manipLearn.time") == 0.5
    assert [float(text) for text in texts.all_text_contents()[1:]] == values(120)


def test_keys_work_after_a_card_was_closed(robot_of, opening, tmp_path, opened):
    """Escape closes a card, and time, camera and scale go on obeying their keys."""
    page = opened(replay(robot_of("sawyer"), opening, tmp_path / "a.html").html.as_uri())
    page.evaluate("manipLearn.seek(0.5)")
    page.locator("#shown summary").click()
    page.keyboard.press("Escape")
    assert not page.locator("#shown section").is_visible()
    page.keyboard.press("Home")
    assert page.evaluate("manipLearn.time") == 0.0
    page.keyboard.press("ArrowRight")
    assert page.evaluate("manipLearn.time") > 0.0
    eye = page.evaluate("manipLearn.eye")
    page.keyboard.press("2")
    assert np.linalg.norm(np.subtract(page.evaluate("manipLearn.eye"), eye)) > 0.1
    page.keyboard.press("l")
    assert page.locator("#log").get_attribute("aria-pressed") == "true"
    page.keyboard.press(" ")  # the card's own key opens it again
    assert page.locator("#shown section").is_visible()


def test_dark_pages_have_lighter_robots(robot_of, opening, tmp_path, opened):
    """When the page turns dark, curves and legend turn lighter together, and back."""
    page = opened(replay(robot_of("sawyer"), opening, tmp_path / "a.html").html.as_uri())
    seen = []
    for scheme, same in (("light", "==="), ("dark", "!=="), ("light", "===")):
        page.emulate_media(color_scheme=scheme)
        wait_until(page, f"document.querySelector('#chart polyline').getAttribute('stroke') {same} '#0072b2'")
        curve = page.locator("#chart polyline").first.get_attribute("stroke")
        legend = page.locator("#legend .rollout").first.evaluate("e => e.style.getPropertyValue('--colour')")
        assert curve == legend
        seen.append(curve)
    light, dark, again = (bytes.fromhex(colour[1:]) for colour in seen)
    assert light == again and all(a < b for a, b in zip(light, dark, strict=True))


def test_marks_are_those_of_the_phase(robot_of, drawer, rollout, tmp_path, opened):
    """In the phase of a constraint its own marks are at the tip; each phase is named by its mechanism."""
    robot = robot_of("sawyer")
    axes = {"line": [0.91, 0.42, 0], "plane": [0, 0, 1]}
    line, plane = ({"type": t, "axis": a, "point": [0.5, 0.2, 0.4], "sentence": f"a {t}"} for t, a in axes.items())
    constraints = (
        Constraint(drawer.selection, drawer.features, {"mechanism": line}),
        Constraint([[0, 0, 1]], drawer.features, {"mechanism": plane}),
    )
    recording = {"a": rollout.trajectory("a")}
    phases = [("a", 0.1, 0.4, 0), ("a", 0.5, 0.9, 1)]
    html = replay(robot, recording, tmp_path / "a.html", constraint=constraints, phases=phases, mechanism=line).html
    page = opened(html.as_uri())
    for t, free, held in ((0.2, 1, 2), (0.7, 2, 1)):
        page.evaluate("t => manipLearn.seek(t)", t)
        marks = page.evaluate("manipLearn.marks('a', manipLearn.time)")
        assert (len(marks["free"]), len(marks["held"])) == (free, held)
    assert page.locator("#mechanism").inner_text().split("\n") == ["1: a line", "2: a plane"]
    key = page.locator("#status-key").inner_text()
    assert "constraint 1: line" in key and "constraint 2: plane" in key
