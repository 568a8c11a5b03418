"""The replay page in headless Chromium: what is shown is what the library computes; controls, escaping, no network."""

from __future__ import annotations

from contextlib import ExitStack, contextmanager
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from conftest import tip_of
from test_playback import EVIL, evil_robot, waving
from test_replay_tracks import START, drawer, rollout  # noqa: F401

import manip_learn as ml
from manip_learn.cli import main as manip_learn
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import FrameJacobian
from manip_learn.constraint.shown import Shown
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.simulation import simulate, simulate_way
from manip_learn.control.tasks import FreeDirection
from manip_learn.errors import ConstraintMismatchError, RecordingError
from manip_learn.playback import LiveViewer, replay
from manip_learn.playback.palette import COLOURS
from manip_learn.playback.recorded_motion import key_frames
from manip_learn.recordings.trajectory import Trajectory

pytestmark = pytest.mark.browser
# ruff: noqa: F811  fixtures of another file are arguments here
READY = "window.manipLearnReady === true"
POSES = 1e-9  # 1e-6 is required; the page computes in double precision
BETWEEN = [0.0, 0.1, 0.105, 0.4637, 0.73, 0.999, 1.0]  # at key frames, at other samples, between samples
PHASES = [("a", 0.5, 1.0, None), ("a", 1.0, 3.0, 0), ("a", 3.0, 3.5, 1), ("b", 0.0, 2.0, 1)]


@contextmanager
def browser_page(chromium, address, width=1000, height=700, phone=False, before="", ready=READY, **more):
    """A page of ours, on a phone if asked; what goes wrong in it, or wants the network, fails the test at last.

    Motion is unwelcome there, so that no page plays unless it is told to.
    """
    trouble: list[str] = []
    looks = {"has_touch": phone, "is_mobile": phone, "reduced_motion": "reduce", **more}
    context = chromium.new_context(viewport={"width": width, "height": height}, **looks)
    page = context.new_page()
    ours = (address.partition("#")[0], "data:", "blob:")
    page.on("pageerror", lambda error: trouble.append(str(error)))
    page.on("console", lambda m: trouble.append(m.text) if m.type == "error" and not before else None)
    page.on("request", lambda r: trouble.append(r.url) if not r.url.startswith(ours) else None)
    page.add_init_script(before or "0")
    page.goto(address)
    wait_until(page, ready)
    yield page
    context.close()
    assert trouble == []


@pytest.fixture
def opened(chromium):
    """Opens pages that stay open during the test."""
    with ExitStack() as pages:
        yield lambda *where, **more: pages.enter_context(browser_page(chromium, *where, **more))


def wait_until(page, expression, seconds=60.0):
    """Wait until an expression is true; Playwright's own way to wait needs eval, which the page's policy forbids."""
    for _ in range(round(50 * seconds)):
        if page.evaluate(expression):
            return
        page.wait_for_timeout(20)
    raise AssertionError(f"{expression} is still false")


def wait_for_frames(page):
    """Wait until what was asked for is drawn: labels are placed after their scene."""
    page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")


def link_pose(page, rollout, link):
    """Pose of a link as the page draws it now."""
    rows = page.evaluate("([rollout, link]) => manipLearn.linkPose(rollout, link)", [rollout, link])
    return np.array(rows).reshape(4, 4)


def seek(page, t):
    """Move the replay to a time."""
    page.evaluate("t => manipLearn.seek(t)", float(t))


def wait_for_rest(page):
    """Wait for the full frame that follows when nothing moves."""
    wait_for_frames(page)
    wait_until(page, "manipLearn.fullFrame")


def picture(page):
    """The scene alone, as PNG."""
    wait_for_rest(page)
    return page.locator("#scene canvas").screenshot(style="#legend, #notes, #scene-key, .sheet { visibility: hidden }")


@pytest.fixture(scope="module")
def address(robot_of, tmp_path_factory):
    """Address of a page, written once for all tests that show the same thing under the same name."""
    folder, written = tmp_path_factory.mktemp("pages"), {}

    def of(name, robot_name, make, **more):
        if name not in written:
            robot = robot_of(robot_name)
            written[name] = replay(robot, make(robot), folder / f"{name}.html", **more).html.as_uri()
        return written[name]

    return of


@pytest.mark.parametrize("name", ["planar3", "mimic"])
def test_links_are_where_kinematics_puts_them(robot_of, tmp_path, opened, name):
    """At key frames, and between them, every link of every rollout is within 1e-9 of forward kinematics."""
    robot = robot_of(name)
    frames = robot.pinocchio_model.frames
    links = [n for n in robot.frame_names if frames[robot.frame(n).index].type == pin.FrameType.BODY]
    rollouts = {"one": waving(robot), "two": waving(robot, phase=1.0)}
    page = opened(replay(robot, rollouts, tmp_path / "a.html").html.as_uri())
    assert page.evaluate("manipLearn.drawing"), "the page has no 3D graphics"
    keys = key_frames(rollouts["one"].time)
    spans = [(i, j, share) for i, j, share in zip(keys[:-1:40], keys[1::40], (0.0, 0.3, 0.9, 0.0, 0.5), strict=False)]
    for i, j, share in [*spans, (keys[-1], keys[-1], 0.0)]:
        time = rollouts["one"].time
        seek(page, time[i] + share * (time[j] - time[i]))
        for which, motion in rollouts.items():
            ends = [robot.positions(motion.q[k]) for k in (i, j)]
            q = robot.configuration(ends[0] + share * (ends[1] - ends[0]))
            for link in links[:: 1 if share == 0.0 else 3]:
                error = np.abs(link_pose(page, which, link) - robot.pose(q, robot.frame(link))).max()
                assert error <= POSES, f"{which}, {link}, sample {i} + {share}: {error:.1e}"


def test_time_obeys_keys_speed_and_curve(robot_of, address, opened):
    """Playing takes time on and pausing holds it; keys, speed, the scrub bar and a drag on the curve move it."""
    motion = waving(robot_of("planar3"), 20.0)
    page = opened(address("long", "planar3", lambda robot: {"a": waving(robot, 20.0)}))
    now = lambda: page.evaluate("manipLearn.time")  # noqa: E731
    page.evaluate("manipLearn.play()")
    wait_until(page, "manipLearn.time > 0.1")
    page.evaluate("manipLearn.pause()")
    held = now()
    wait_for_frames(page)
    assert now() == held > 0.0
    keys = motion.time[key_frames(motion.time)]
    for key, expected in (
        *(("Home", 0.0), ("ArrowRight", keys[1]), ("ArrowRight", keys[2]), ("ArrowRight", keys[3])),
        *(("ArrowLeft", keys[2]), ("Shift+ArrowRight", keys[2] + 1.0), ("End", 20.0), ("ArrowLeft", keys[-2])),
    ):
        page.keyboard.press(key)
        assert now() == pytest.approx(expected, abs=1e-9), key
    page.keyboard.press("Home")
    for playing in (True, False):
        page.keyboard.press("Space")
        assert page.evaluate("manipLearn.playing") is playing
    page.keyboard.press("ArrowUp")
    assert page.locator("#speed").input_value() == "2"
    assert page.locator("#speed option").all_inner_texts() == ["0.1×", "0.25×", "0.5×", "1×", "2×", "4×"]
    page.locator("#scrub").fill("7.5")
    assert now() == pytest.approx(7.5, abs=0.05)
    box = page.locator("#chart").bounding_box()
    left, right, y = box["x"] + 58, box["x"] + box["width"] - 14, box["y"] + 40
    page.mouse.move(left + 0.25 * (right - left), y)
    page.mouse.down()
    assert now() == pytest.approx(5.0, abs=0.1)
    page.mouse.move(left + 0.75 * (right - left), y)
    page.mouse.up()
    assert (t := now()) == pytest.approx(15.0, abs=0.1)
    expected = float(np.interp(t, motion.time, motion.manipulability))
    assert float(page.locator("#legend .mu").inner_text().split()[0]) == float(f"{expected:.2g}")
    assert page.locator("#clock").inner_text() == f"{t:.2f} s"
    cursor = page.locator("#chart line[stroke-width='1.5']").get_attribute("x1")
    assert float(cursor) + box["x"] == pytest.approx(left + 0.75 * (right - left), abs=3.0)


def test_it_plays_once_and_keys_work_after_clicks(address, opened):
    """An opened page plays up to its end, unless motion is unwelcome; a button that was clicked keeps no keys."""
    made = address("short", "planar3", lambda robot: {"plan": waving(robot, 1.0)})
    page = opened(made, reduced_motion="no-preference")
    wait_until(page, "manipLearn.time > 0.0")
    wait_until(page, "!manipLearn.playing")
    assert page.evaluate("manipLearn.time") == page.evaluate("manipLearn.duration") == pytest.approx(1.0)
    still = opened(made)
    assert still.evaluate("[manipLearn.playing, manipLearn.time]") == [False, 0.0]
    for button in ("#loop", "[data-view=top]", "#legend .pick"):
        still.locator(button).first.click()
        before = still.evaluate("manipLearn.time")
        still.keyboard.press("ArrowRight")
        assert still.evaluate("manipLearn.time") > before, button
        still.keyboard.press("Home")
        still.keyboard.press("Space")
        assert still.evaluate("manipLearn.playing"), button
        still.evaluate("manipLearn.seek(0)")
    said = still.locator("body").inner_text()
    assert "plan" in said and not any(colour in said for colour in COLOURS)


def test_hostile_names_do_nothing(tmp_path, opened):
    """Markup in names shows as text, of phases and mechanisms too; no script of it runs; such links are found."""
    robot = evil_robot(tmp_path)
    motion = waving(robot)
    evil = replace(motion, status=(EVIL,) * len(motion))
    page = opened(replay(robot, {EVIL: evil}, tmp_path / "a.html", title=EVIL).html.as_uri())
    for place in ("#robot-name", "#subtitle", "#legend .name"):
        assert page.locator(place).inner_text() == EVIL
    assert page.locator("#status-key").inner_text() == "slowed"
    span = f"0.00 s to {motion.time[-1]:.2f} s"
    assert page.locator("#chart rect title").all_text_contents() == [f"{EVIL}: slowed ({EVIL}), {span}"]
    np.testing.assert_allclose(link_pose(page, EVIL, EVIL), robot.pose(motion.q[0], robot.frame(EVIL)), atol=POSES)
    hinge = HINGE | {"sentence": f"a hinge {EVIL}"}
    recording, phases = {EVIL: motion.trajectory(EVIL)}, [(EVIL, 0.0, 2.0, 0)]
    phased = opened(replay(robot, recording, tmp_path / "b.html", phases=phases, mechanism=hinge).html.as_uri())
    assert phased.locator("#phase").inner_text() == f"{EVIL}: constraint 1: hinge"
    titles = phased.locator("#chart .bands title").all_text_contents()
    assert titles == [EVIL, f"{EVIL}: constraint 1: hinge, 0.00 s to 2.00 s"]
    assert phased.locator("#mechanism").inner_text() == f"Mechanism: a hinge {EVIL}"
    for each in (page, phased):
        assert each.evaluate("window.hacked") is None and each.locator("img").count() == 0


def recordings(robot):
    """Two recordings of 4 s and 2 s."""
    return {"a": waving(robot, 4.0).trajectory("a"), "b": waving(robot, 2.0, phase=1.0).trajectory("b")}


def test_phases_are_bands_at_their_times(address, opened):
    """Bands from start to end in the colours of the legend; named while playing; the slider obeys."""
    page = opened(address("phases", "planar3", recordings, phases=PHASES))
    colours = dict(zip(["constraint 1", "constraint 2", "free motion"], ["#0072b2", "#d55e00", "#8a95a0"], strict=True))
    bars = page.evaluate(
        """() => [...document.querySelectorAll("#chart .bands rect")].map(r => {
            const box = r.getBoundingClientRect();
            return [box.left, box.right, r.getAttribute("fill"), r.querySelector("title").textContent];
        })"""
    )
    expected = ["free motion", "constraint 1", "constraint 2", "constraint 2"]
    for (left, right, fill, title), (name, start, end, _), label in zip(bars, PHASES, expected, strict=True):
        assert (fill, title) == (colours[label], f"{name}: {label}, {start:.2f} s to {end:.2f} s")
        for x, t in ((left, start), (right, end)):
            seek(page, t)
            cursor = page.locator("#chart line[stroke-width='1.5']").bounding_box()
            assert x == pytest.approx(cursor["x"] + cursor["width"] / 2, abs=1.5)
    key = page.locator("#status-key span").all_inner_texts()
    assert [text.strip().split("\n")[-1] for text in key] == [*colours, "not classified"]
    assert page.locator("#panel-title").inner_text() == "Phases"
    for t, first, second in (
        *((0.2, "not classified", "constraint 2"), (0.7, "free motion", "constraint 2")),
        *((1.0, "constraint 1", "constraint 2"), (3.2, "constraint 2", "ended at 2.00 s")),
    ):
        seek(page, t)
        assert page.locator("#phase").inner_text() == f"a: {first}"
        assert page.locator("#legend .state").all_inner_texts() == [first, second]
    band, slider = page.locator("#scrub-bands rect").nth(1).bounding_box(), page.locator("#scrub").bounding_box()
    page.mouse.click(band["x"], slider["y"] + slider["height"] / 2)
    assert page.evaluate("manipLearn.time") == pytest.approx(1.0, abs=0.03)
    seek(page, 0.5)
    page.locator("#legend .pick").nth(1).click()
    assert page.locator("#phase").inner_text() == "b: constraint 2" and page.locator("#scrub-bands rect").count() == 1


def test_live_view_follows(robot_of, opened):
    """The browser shows the posture that was given last."""
    robot = robot_of("wrist")
    with LiveViewer(robot, open_browser=False) as viewer:
        page = opened(viewer.url)
        for angle in (0.3, -1.1):
            q = np.full(robot.nv, angle)
            viewer.show(q, manipulability=abs(angle), time=10.0 + angle)
            wait_until(page, f"Math.abs(manipLearn.time - {10.0 + angle}) < 1e-9")
            np.testing.assert_allclose(
                link_pose(page, robot.name, "tip"), robot.pose(q, robot.frame("tip")), atol=POSES
            )
        assert page.evaluate("manipLearn.drawing")


def test_live_view_draws_constraint_and_target(robot_of, opened):
    """The mechanism and the target stand in the robot's base, the floor at its foot; a constraint of another robot is
    refused.
    """
    robot = robot_of("sawyer")
    constraint, hold = shown_drawer(robot)
    goal = robot.pose(START, robot.frame("right_gripper_tip"))
    with LiveViewer(robot, constraint=constraint, target=goal, open_browser=False) as viewer:
        page = opened(viewer.url)
        bare = picture(page)
        viewer.show(START, time=1.0)
        wait_until(page, "manipLearn.time === 1")
        data = page.evaluate("JSON.parse(document.getElementById('data').textContent)")
        np.testing.assert_allclose(data["rollouts"][0]["marks"][0]["target"]["point"], hold, atol=1e-9)
        assert [m["type"] for m in data["mechanisms"]] == ["line"] and data["floor"] == 0.0
        assert picture(page) != bare
    with pytest.raises(ConstraintMismatchError):
        LiveViewer(robot_of("planar3"), constraint=constraint, open_browser=False)


def shown_drawer(robot):
    """A drawer as it is learnt from recordings that took hold where the hand is at START, and pulled it towards -x."""
    hold = robot.position(START, robot.frame("right_gripper_tip"))
    free = ml.Mechanism("line", [-1.0, 0.0, 0.0])
    path, times = np.linspace(0.0, 0.12, 20)[:, None], np.linspace(0.0, 1.2, 20)
    numbers = 0.12, 0.0, 0.12, 0.12, 0.12, 0.1, 1.2
    shown = Shown("m", *numbers, True, 5, hold, 0.0, path, times, hold, np.eye(3), 0.0, True, free)
    line = {"type": "line", "axis": [1.0, 0.0, 0.0], "point": hold.tolist(), "sentence": "a line along x"}
    kept = {"mechanism": line, "shown": shown.to_dict(), "kind": "motion-constrained", "n_constraints": 2}
    return Constraint([[0, 1, 0], [0, 0, 1]], FrameJacobian(robot, "right_gripper_tip"), kept), hold


def test_what_was_shown_is_drawn_and_what_was_done_is_told(robot_of, tmp_path, opened):
    """A drawer that is shut where recordings took hold is so on every page: of a rollout that comes from aside, and of
    one that shuts it again; its table says where the hand took hold, how far, and how well.
    """
    robot = robot_of("sawyer")
    constraint, hold = shown_drawer(robot)
    away = robot.positions(START) + [0.1, -0.1, 0.0, 0.1, 0.0, 0.0, 0.0]
    pages = {}
    for name, task in (("as shown", ml.motion(constraint)), ("back", ml.motion(constraint, 0.08, direction="back"))):
        law = ResolvedRateController(constraint, task, task.ascent())
        pages[name] = simulate_way(robot, law, away, 0.01)[0]
    page = opened(replay(robot, pages, tmp_path / "a.html").html.as_uri())
    for t, name, far in ((0.0, "as shown", 0.0), (9.0, "as shown", 0.12), (0.0, "back", 0.08), (9.0, "back", 0.0)):
        seek(page, t)
        handle = page.evaluate("name => manipLearn.handle(name)", name)
        np.testing.assert_allclose(handle, hold - [far, 0.0, 0.0], atol=2e-3, err_msg=f"{name} {t}")
    assert "took hold at the same place, moved 0.12 m" in page.locator("#mechanism").inner_text()
    page.locator("#done summary").click()
    table = page.locator("#done table").inner_text()
    for told in ("as shown", "back", ", ".join(f"{x:.3f}" for x in hold)[:12], "0.12 of 0.12 m", "mm", "of its limit"):
        assert told in table


def test_values_and_marks_are_the_librarys(robot_of, drawer, rollout, address, opened):
    """Every curve of every track, directions held and free, and semi-axes that are the singular values."""
    robot = robot_of("sawyer")
    slipping = replace(rollout, following_error=np.linspace(0.0, 0.02, len(rollout)) ** 2)
    page = opened(address("slipping", "sawyer", lambda _: {"a": slipping}))
    sigma = np.array([np.linalg.svd(drawer(q), compute_uv=False) for q in rollout.q])
    low, span, names = robot.position_lower, robot.position_upper - robot.position_lower, robot.joint_names
    tracks = {
        "singular": {f"σ{k + 1}": values for k, values in enumerate(sigma.T)},
        "velocity": dict(zip(names, (rollout.u / robot.velocity_limit).T, strict=True)),
        "position": dict(zip(names, ((rollout.q - low) / span).T, strict=True)),
        "task-error": {"": rollout.task_error},
        "following-error": {"": slipping.following_error},
    }
    for t in BETWEEN:
        shown = page.evaluate("t => manipLearn.trackValues(t)", t)
        assert shown.keys() == tracks.keys()
        for kind, curves in tracks.items():
            expected = {name: np.interp(t, rollout.time, values) for name, values in curves.items()}
            assert shown[kind]["a"] == pytest.approx(expected, rel=1e-5, abs=1e-6), f"{kind} at {t} s"
        seek(page, t)
        marks = page.evaluate("t => manipLearn.marks('a', t)", t)
        i = int(np.searchsorted(rollout.time, t + 1e-9) - 1)
        j = min(i + 1, len(rollout) - 1)
        share = 0.0 if i == j else (t - rollout.time[i]) / (rollout.time[j] - rollout.time[i])
        A = [drawer(rollout.q[k]) for k in (i, j)]
        M = drawer.selection.T @ ((1.0 - share) * A[0] @ A[0].T + share * A[1] @ A[1].T) @ drawer.selection
        lengths = [axis["length"] for axis in marks["ellipsoid"]]
        np.testing.assert_allclose(lengths, np.sqrt(np.maximum(np.linalg.eigvalsh(M)[::-1], 0.0)), atol=2e-4)
        if share < 1e-9:
            np.testing.assert_allclose(lengths[:2], np.linalg.svd(A[0], compute_uv=False), atol=1e-5)
        held, (free,) = np.array(marks["held"]), np.array(marks["free"])
        np.testing.assert_allclose(held @ held.T, np.eye(2), atol=1e-6)
        np.testing.assert_allclose(held.T @ held, drawer.selection.T @ drawer.selection, atol=1e-6)
        np.testing.assert_allclose(drawer.selection @ free, 0.0, atol=1e-6)
    local = Constraint(drawer.selection, FrameJacobian(robot, "right_gripper_tip", "xyz", "local"))
    page = opened(address("local", "sawyer", lambda _: {"a": rollout}, constraint=local))
    for i in (0, 60, 100):  # rows along the hand's axes are drawn in them, where kinematics puts these
        seek(page, rollout.time[i])
        pose = np.array(page.evaluate("manipLearn.marks('a', manipLearn.time).pose")).reshape(4, 4)
        np.testing.assert_allclose(pose, robot.pose(rollout.q[i], local.features.frame), atol=1e-6)


def test_tracks_marks_and_cards_are_switched(drawer, rollout, address, opened):
    """Each box of a track adds it with its values, all cursors agree; each box of the scene changes the picture; one
    card is open at a time, and escape closes it.
    """
    kept = Constraint(drawer.selection, drawer.features, {"sentence": "moves freely along x", "gap": 12.0})
    page = opened(address("kept", "sawyer", lambda _: {"a": rollout}, constraint=kept))
    assert page.locator("#tracks .track").count() == 0
    page.locator("#track-choice summary").click()
    for kind in ("singular", "velocity"):
        page.locator(f"[data-track={kind}]").check()
    page.locator("#track-choice summary").click()
    titles = page.locator("#tracks figcaption b").all_inner_texts()
    assert titles == ["Singular values of A", "Joint velocities over their limits"]
    box = page.locator("#tracks .curves").first.bounding_box()
    left, right = box["x"] + 58, box["x"] + box["width"] - 14
    page.mouse.click(left + 0.6 * (right - left), box["y"] + 30)
    assert page.evaluate("manipLearn.time") == pytest.approx(0.6, abs=0.01)
    cursors = page.locator("#tracks .cursor, #chart line[stroke-width='1.5']").evaluate_all(
        "lines => lines.map((line) => Number(line.getAttribute('x1')))"
    )
    assert len(cursors) == 3 and max(cursors) - min(cursors) < 1e-6
    sigma = page.evaluate("manipLearn.trackValues(manipLearn.time).singular.a")["σ1"]
    assert float(page.locator("#tracks .value span").first.inner_text()) == float(f"{sigma:.2g}")
    page.locator("#track-choice summary").click()
    page.locator("[data-track=first]").uncheck()
    assert not page.locator("#chart").is_visible() and page.locator("#tracks .track").count() == 2
    page.locator("[data-track=first]").check()
    page.keyboard.press("Escape")
    assert not page.locator("#track-choice section").is_visible()
    page.locator("#shown summary").click()
    names = page.locator("[data-shown]").evaluate_all("boxes => boxes.map((box) => [box.dataset.shown, box.checked])")
    assert names == [["constraint", True], ["target", True], ["ellipsoid", True], ["paths", True]]
    for name, _ in names:
        before = picture(page)
        page.locator(f"[data-shown={name}]").click()
        assert picture(page) != before, name
    page.locator("#evidence summary").click()
    wait_until(page, "!document.querySelector('#shown').open", 5.0)
    told = page.locator("#evidence section").inner_text()
    assert "moves freely along x" in told and "12" in told and "10 and above is clear" in told
    page.keyboard.press("Escape")


def test_recordings_are_coloured_by_their_fit(robot_of, drawer, rollout, tmp_path, opened):
    """Bands change from the phases to how well each sample fits the constraint, and back; odd recordings are marked."""
    robot = robot_of("sawyer")
    wrong = rollout.u + 0.5 * np.linalg.pinv(drawer(rollout.q[0]))[:, 0]
    demos = {"a": rollout.u, "b": rollout.u, "c": wrong}  # the last one breaks the constraint
    named = {n: Trajectory(rollout.time, rollout.q, u, robot.joint_names, n) for n, u in demos.items()}
    report = {"sentence": "moves freely along x", "gap": 12.0, "odd_trajectories": [["c", "moves 3 mm"]]}
    more = {"constraint": drawer, "report": report, "phases": [(n, 0.2, 0.8, 0) for n in named]}
    page = opened(replay(robot, named, tmp_path / "a.html", **more).html.as_uri())
    rows = page.locator("#chart .bands")
    before, key = rows.nth(2).inner_html(), page.locator("#status-key").inner_text()
    page.locator("#shown summary").click()
    page.locator("[name=colours][value=fit]").check()
    assert "100 %" in page.locator("#status-key").inner_text()
    middle = "bands => { const bars = [...bands.querySelectorAll('rect')]; return bars[bars.length >> 1].textContent; }"
    shares = page.evaluate("manipLearn.trackValues(0.5).fit")
    for k, name in enumerate("abc"):
        said = rows.nth(k).evaluate(middle).split(": ")[1].split(" %")[0]
        assert float(said) == pytest.approx(100.0 * shares[name]["share"], abs=1.0)
    page.locator("[name=colours][value=phase]").check()
    assert rows.nth(2).inner_html() == before and page.locator("#status-key").inner_text() == key
    assert page.locator("#legend .name").all_inner_texts() == ["a", "b", "c odd"]


@pytest.fixture(scope="module")
def opening(drawer):
    """Two rollouts that pull the drawer by 15 and by 8 cm, whose constraint keeps its mechanism."""
    line = {"type": "line", "axis": [0.91, 0.42, 0.0], "point": [0.0, 0.0, 0.9], "sentence": "a line"}
    kept = Constraint(drawer.selection, drawer.features, {"n_constraints": 2, "mechanism": line})
    tasks = {"far": FreeDirection(kept, -0.15, 0.4), "near": FreeDirection(kept, -0.08, 0.4)}
    robot = drawer.features.robot
    return {n: simulate(robot, ResolvedRateController(kept, task), START, 1.2, 0.01) for n, task in tasks.items()}


def test_the_drawer_is_in_the_hand_and_says_how_far_it_is_open(robot_of, opening, address, opened):
    """At any time, of whichever rollout is solid; legends and the readout say what the curves have; every mark is in
    the first view; a dark page has lighter curves.
    """
    robot = robot_of("sawyer")
    page = opened(address("opening", "sawyer", lambda _: opening), 1280, 800)
    for t in (0.0, 1.2):
        seek(page, t)
        assert page.locator("#scene-key li:visible").count() == 6
    for k, name in enumerate(opening):
        page.locator("#legend .pick").nth(k).click()
        for i in (0, 50, 120):
            t = float(opening[name].time[i])
            seek(page, t)
            handle = page.evaluate("name => manipLearn.handle(name)", name)
            tip = robot.position(opening[name].q[i], robot.frame("right_gripper_tip"))
            np.testing.assert_allclose(handle, tip, atol=1e-3)
            value = page.evaluate("([t, name]) => manipLearn.trackValues(t).opening[name]['']", [t, name])
            assert f"handle moved {value:.3f} m" in page.locator("#scene-key li:visible").all_inner_texts()
            assert f"moved {value:.3f} m" in page.locator("#legend .state").nth(k).inner_text()
        assert value == pytest.approx({"far": 0.15, "near": 0.08}[name], abs=2e-3)
    words = page.locator("#scene-key li:visible").all_inner_texts()
    assert {"free to move", "held", "target", "line that was learnt"} <= set(words)
    assert any("speed within reach (μ)" in row and "m for 1 m/s" in row for row in words)
    assert page.locator("#legend .name").all_inner_texts() == list(opening)  # every arm that is drawn has its name
    page.locator("#legend .pick").nth(0).click()
    texts, box = page.locator("#chart .readout:not([hidden]) p"), page.locator("#chart").bounding_box()
    seek(page, 0.5)
    assert texts.count() == 0
    page.mouse.move(box["x"] + box["width"] - 14, box["y"] + 40)  # over the curves
    values = [f"{r.manipulability[120]:.2g} {name}" for name, r in opening.items()]
    assert texts.all_text_contents() == ["1.20 s", *values] and page.evaluate("manipLearn.time") == 0.5
    for scheme, same in (("light", "==="), ("dark", "!=="), ("light", "===")):
        page.emulate_media(color_scheme=scheme)
        wait_until(page, f"document.querySelector('#chart .curve').getAttribute('stroke') {same} '#0072b2'")
        legend = page.locator("#legend .rollout").first.evaluate("e => e.style.getPropertyValue('--colour')")
        assert page.locator("#chart .curve").first.get_attribute("stroke") == legend


def test_two_panes_on_one_clock(robot_of, opening, tmp_path, opened):
    """Each pane shows its own rollout alone, the clock is zero where the hand takes hold in both, captions say what
    became of them; the address opens a moment and a view, and the picture is saved.
    """
    robot, halves = robot_of("sawyer"), {}
    far, near = opening.values()
    way = {"name": "way", "wanted": 0.15, "done": 0.15, "unit": "m", "stopped_by": None, "deviation": 0.0}
    early, late = (replace(r, ways=({**way, "begins": begins},)) for r, begins in ((far, 0.2), (near, 0.5)))
    for name, second in (("other", late), ("same", early)):
        made = replay(robot, {"a": early, "b": second}, tmp_path / f"{name}.html", side_by_side=True, align="grasp")
        page = opened(f"{made.html.as_uri()}#t=0.4&view=top")
        zero = 0.5 if name == "other" else 0.2
        assert page.evaluate("manipLearn.time") == pytest.approx(zero + 0.4)
        assert page.locator("#clock").inner_text() == "0.40 s"
        assert page.locator(".panes p").all_inner_texts() == [f"{n}0.15 of 0.15 m" for n in "ab"]
        wait_for_rest(page)
        box = page.locator("#scene canvas").bounding_box()
        clip = {"x": box["x"], "y": box["y"], "width": box["width"] / 2, "height": box["height"] - 60}
        halves[name] = [page.screenshot(clip={**clip, "x": clip["x"] + k * clip["width"]}) for k in (0, 1)]
    assert halves["other"][0] == halves["same"][0] and halves["other"][1] != halves["same"][1]
    with page.expect_download() as saved:
        page.locator("#save").click()
    assert saved.value.path().read_bytes()[:4] == b"\x89PNG"
    page.locator("#play").click()
    page.locator("#play").click()
    assert page.evaluate("location.hash").startswith("#t=") and "view=top" in page.evaluate("location.hash")
    for wrong in ({"align": "contact"}, {"side_by_side": True}):
        with pytest.raises(RecordingError, match="align|side_by_side"):
            replay(robot, {"a": early}, tmp_path / "c.html", **wrong)


def test_a_plan_beside_other_rollouts(robot_of, opening, tmp_path, opened):
    """Its band has the words, its drawer is shut until the way begins, and the others are drawn as without it."""
    robot, way, time = robot_of("sawyer"), opening["far"], np.arange(101) * 0.01
    aside = np.outer(np.sin(np.pi * time) ** 2, [0.3, 0.4, 0.0, -0.3, 0.0, 0.2, 0.0])
    curves = {"manipulability": 0.0 * time + 0.05, "task_error": 0.0 * time, "status": ("ok",) * 101}
    approach = replace(way, time=time, q=START + aside, u=0.0 * aside, phases=(("approach", 0.0, 1.0),), **curves)
    plan = approach.followed_by(replace(way, phases=(("hold", 0.0, 0.1), ("way", 0.1, 1.2))))
    page = opened(replay(robot, {"plan": plan, **opening}, tmp_path / "a.html").html.as_uri(), 1280, 800)
    assert page.locator("#chart .bands text:not(.mark)").all_text_contents() == ["planplan"]  # with its title
    assert page.locator("#chart .bands .mark").all_text_contents() == ["approach", "hold", "way"]
    for t, phase, shut in ((0.0, "approach", True), (0.5, "approach", True), (1.05, "hold", True), (2.2, "way", False)):
        seek(page, t)
        assert page.locator("#phase").inner_text() == f"plan: {phase}"
        states = page.locator("#legend .state").all_inner_texts()
        assert [phase in state for state in states] == [True, False, False]
        assert ("moved 0.000 m" in states[0]) == shut
        wait_for_frames(page)
        labels = page.locator("#scene-key li:visible").all_text_contents()
        assert ("held" in labels) == (phase != "approach")
    begins = robot.position(plan.q[110], robot.frame("right_gripper_tip"))
    seek(page, 0.5)
    np.testing.assert_allclose(page.evaluate("manipLearn.handle('plan')"), begins, atol=1e-3)
    np.testing.assert_allclose(page.evaluate("manipLearn.trackValues(2.2).opening.plan['']"), 0.15, atol=4e-3)
    colours = page.locator("#legend .rollout").evaluate_all("all => all.map(e => e.style.getPropertyValue('--colour'))")
    assert len(set(colours)) == 3


# ---- what a frame costs ---------------------------------------------------------

# triangles and draw calls of each frame, shadows and all panes included
COUNTED = """
window.frames3d = [];
window.delay = 0;
let now = [0, 0];
const count = (mode, corners) => { now[0] += mode === 4 ? corners / 3 : 0; now[1] += 1; };
for (const P of [WebGLRenderingContext.prototype, WebGL2RenderingContext.prototype]) {
  const { drawElements, drawArrays } = P;
  P.drawElements = function (...a) { count(a[0], a[1]); return drawElements.apply(this, a); };
  P.drawArrays = function (...a) { count(a[0], a[2]); return drawArrays.apply(this, a); };
}
const ask = requestAnimationFrame;
window.requestAnimationFrame = (f) => ask((t) => {
  now = [0, 0];
  f(t);
  if (now[1]) frames3d.push(now);
  const end = performance.now() + delay;
  while (performance.now() < end) continue;
});
"""
CARD = """
for (const P of [WebGLRenderingContext.prototype, WebGL2RenderingContext.prototype]) {
  const { getParameter } = P;
  const names = { 7937: "A graphics card", 37446: "A graphics card" };
  P.getParameter = function (key) { return names[key] ?? getParameter.call(this, key); };
}
"""


@pytest.mark.parametrize("name", ["demo", "panda", "ur5e"])
def test_a_frame_is_cheap(name, tmp_path, address, opened):
    """With a graphics card, where all is drawn: two arms side by side of the demo, or a solid one and a ghost."""
    if name == "demo":
        assert manip_learn(["demo", "--no-browser", "--out", str(tmp_path)]) == 0
        path, most = tmp_path / "replay.html", 150_000
        assert path.stat().st_size < 2_500_000
        of = path.as_uri()
    else:
        of, most = address(name, name, lambda robot: {"a": waving(robot), "b": waving(robot, phase=0.8)}), 300_000
    page = opened(of, 1280, 800, before=COUNTED + CARD)
    duration = page.evaluate("manipLearn.duration")
    for share in (0.0, 0.5, 1.0):
        page.evaluate("frames3d.length = 0")
        seek(page, share * duration)
        wait_until(page, "frames3d.length > 0")
        triangles, calls = page.evaluate("frames3d[0]")
        assert 0 < triangles <= most and 0 < calls <= 120


def test_without_a_graphics_card_frames_are_simpler_while_something_moves(opening, address, opened):
    """Fewer pixels and no shadows by the name of the renderer or after slow frames; when it rests, all of it again."""
    canvas = "document.querySelector('#scene canvas').width / document.querySelector('#scene').clientWidth"
    of = address("opening", "sawyer", lambda _: opening)
    for before, full in ((COUNTED, 2.0), (COUNTED + CARD, 1.0)):
        page = opened(of, 800, 600, before=before)
        wait_for_rest(page)
        (shadowed, calls), ratio = page.evaluate("frames3d.at(-1)"), page.evaluate(canvas)
        assert ratio == pytest.approx(full, abs=0.01)
        if before != COUNTED:  # frames are late, whatever the renderer says that it is
            page.evaluate("delay = 60")
        page.locator("#loop").click()
        page.evaluate("manipLearn.play()")
        wait_until(page, f"!manipLearn.fullFrame && {canvas} < 0.62")
        triangles, fewer = page.evaluate("frames3d.at(-1)")
        assert triangles < shadowed and fewer < calls
        page.evaluate("manipLearn.pause()")
        wait_for_rest(page)
        assert page.evaluate(canvas) == pytest.approx(full, abs=0.01)


# ---- on a phone, and for screen readers ----------------------------------------

FINGER = 40  # least width and height of what a finger must hit [px]
# a check box or a choice is hit by its label
CONTROLS = "button, select, summary, input[type=range], label:has(input)"
HINGE = {"type": "hinge", "axis": [0, 0, 1], "point": [0.5, 0.5, 0.1], "radius": 0.6, "sentence": "a hinge"}
REPORT = {
    "sentence": "the hand is held", "gap": 3940.0, "n_constraints": 2, "held_out_residual": 0.012,
    "uncertainty_deg": 0.2, "n_samples": 600, "n_trajectories": 2, "warnings": ["recordings are few"],
    "odd_trajectories": [["b", "moves 3 mm"]],
}  # fmt: skip
ALL_TRACKS = "document.querySelectorAll('#sheets input').forEach(box => { if (!box.checked) box.click(); })"
# one of the lists and cards open, the others closed; a number beyond them closes all
OPEN_ONE = "n => document.querySelectorAll('details').forEach((list, i) => { list.open = i === n; })"


@pytest.fixture
def phased(robot_of, tmp_path):
    """Address of a page that has all that a page can have."""
    robot = robot_of("planar3")
    guided = Constraint(np.eye(2), FrameJacobian(robot, tip_of(robot.name), "x y"))
    more = {"phases": PHASES, "mechanism": HINGE, "constraint": (guided, guided), "report": REPORT}
    notes = ["a note about a_very_long_file_name_that_has_no_space_in_it_and_goes_on_and_on.mcap"]
    path, more = tmp_path / "phases.html", more | {"target": [0.4, 0.3], "notes": notes}
    return replay(robot, recordings(robot), path, title="drawer, 3 times", **more).html.as_uri()


def boxes(page, selector):
    """Text or id, and box, of the controls that can be seen."""
    return page.evaluate(
        """selector => [...document.querySelectorAll(selector)].filter(e => e.checkVisibility()).map(e => {
            const box = e.getBoundingClientRect();
            return [e.id || e.textContent.trim(), box.left, box.right, box.width, box.height];
        })""",
        selector,
    )


def test_phones_show_everything_without_sideways_scrolling(phased, opened):
    """On a phone nothing is wider than the screen, and every control is large enough for a finger; robot and curve are
    there before anything is scrolled, names and notes below.
    """
    width = 390
    page = opened(phased, width, 844, phone=True)
    (_, top, *_), (_, floor, *_) = (page.locator(s).bounding_box().values() for s in ("#scene", "#transport"))
    chart, legend = (page.locator(s).bounding_box() for s in ("#chart", "#legend"))
    assert 0.0 < top < chart["y"] < chart["y"] + chart["height"] <= floor + 2.0
    assert legend["y"] >= chart["y"] + chart["height"]
    page.evaluate(ALL_TRACKS)
    for list_open in range(page.locator("details").count()):
        page.evaluate(OPEN_ONE, list_open)
        assert page.evaluate("[document.documentElement.scrollWidth, innerWidth]") == [width, width]
        for name, left, right, across, down in boxes(page, CONTROLS):
            assert left >= 0 and right <= width and across >= FINGER and down >= FINGER, (width, name)
        for name, left, right, *_ in boxes(page, "#legend *, #chart, #tracks, .sheet, #notes, #transport, canvas"):
            assert left >= -0.5 and right <= width + 0.5, (width, name)


def keeps_no_reader_out(page):
    """Axe finds no violation that is serious or worse, light and dark."""
    base = pytest.importorskip("axe_playwright_python.base", reason="NO AXE: ACCESSIBILITY IS NOT TESTED")
    page.evaluate(base.AXE_SCRIPT)
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        wait_for_frames(page)
        found = page.evaluate("axe.run(document, { resultTypes: ['violations'] })")
        serious = [v for v in found["violations"] if v["impact"] in ("serious", "critical")]
        assert [(v["id"], [n["target"] for n in v["nodes"]]) for v in serious] == [], scheme


def test_nothing_keeps_readers_out(phased, opened):
    """Axe finds no violation that is serious or worse, light and dark, with all that can be shown."""
    page = opened(phased)
    page.evaluate(ALL_TRACKS)
    page.evaluate("document.querySelectorAll('details').forEach(list => { list.open = true; })")
    keeps_no_reader_out(page)


def test_no_3d_graphics_says_what_to_do(address, opened):
    """Without WebGL the page says what to do, and its curves and numbers still play."""
    names = [f"a rather long name of a rollout, number {i}" for i in range(3)]
    of = address("plain", "planar3", lambda robot: {name: waving(robot, 3.0) for name in names})
    page = opened(of, before="HTMLCanvasElement.prototype.getContext = () => null")
    assert not page.evaluate("manipLearn.drawing")
    words = page.locator("#no-webgl").inner_text()
    assert "WebGL" in words and "hardware acceleration" in words and "another browser" in words
    page.evaluate("manipLearn.seek(1)")
    assert page.locator("#clock").inner_text() == "1.00 s" and page.locator("#chart .curve").count() == 3
