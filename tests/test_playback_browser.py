"""The replay page in headless Chromium: what is shown is what the library computes; controls, escaping, no network."""

from __future__ import annotations

from contextlib import ExitStack, contextmanager
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from scipy.interpolate import interp1d
from test_playback import EVIL, evil_robot, waving
from test_replay_tracks import START, drawer, rollout  # noqa: F401

import manip_learn as ml
from manip_learn.constraint.shown import Shown
from manip_learn.control.simulation import simulate_way
from manip_learn.errors import ConstraintMismatchError, RecordingError
from manip_learn.playback import LiveViewer
from manip_learn.playback.recorded_motion import key_frames

pytestmark = pytest.mark.browser
# ruff: noqa: F811  fixtures of another file are arguments here
READY = "window.manipLearnReady === true"
TIP = "right_gripper_tip"
POSES = 1e-9  # 1e-6 is required; the page computes in double precision
BETWEEN = [0.0, 0.105, 0.4637, 1.0]  # at key frames, at other samples, between samples
PHASES = [("a", 0.5, 1.0, None), ("a", 1.0, 3.0, 0), ("a", 3.0, 3.5, 1), ("b", 0.0, 2.0, 1)]
HINGE = {"type": "hinge", "axis": [0, 0, 1], "point": [0.5, 0.5, 0.1], "radius": 0.6, "sentence": f"a hinge {EVIL}"}


@contextmanager
def browser_page(chromium, address, width=1000, height=700, before="", ready=READY, **more):
    """Open one of our pages; errors in it and requests to the network fail the test when it closes.

    The page asks for reduced motion, so it plays only when told to. `before` is a script that runs first.
    """
    errors: list[str] = []
    context = chromium.new_context(viewport={"width": width, "height": height}, **{"reduced_motion": "reduce"} | more)
    page = context.new_page()
    ours = (address.partition("#")[0], "data:", "blob:")
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda m: errors.append(m.text) if m.type == "error" and not before else None)
    page.on("request", lambda r: errors.append(r.url) if not r.url.startswith(ours) else None)
    page.add_init_script(before or "0")
    page.goto(address)
    wait_until(page, ready)
    yield page
    context.close()
    assert errors == []


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
    wait_for_frames(page)


def picture(page):
    """The scene at rest alone, as PNG."""
    wait_for_frames(page)
    wait_until(page, "manipLearn.fullFrame")
    return page.locator("#scene canvas").screenshot(style="#legend, #notes, #scene-key, .sheet { visibility: hidden }")


@pytest.fixture
def page_of(tmp_path, opened):
    """Opens the page of a replay."""

    def of(robot, shown, *size, view="", page=None, **more):
        made = ml.replay(robot, shown, tmp_path / "a.html", open_browser=False, **more).html.as_uri()
        return opened(made + view, *size, **(page or {}))

    return of


def test_links_are_where_kinematics_puts_them(robot_of, page_of):
    """At key frames, and between them, every link of every rollout is within 1e-9 of forward kinematics."""
    robot = robot_of("mimic")
    frames = robot.pinocchio_model.frames
    links = [n for n in robot.frame_names if frames[robot.frame(n).index].type == pin.FrameType.BODY]
    rollouts = {"one": waving(robot), "two": waving(robot, phase=1.0)}
    page, time = page_of(robot, rollouts), rollouts["one"].time
    assert page.evaluate("manipLearn.drawing"), "the page has no 3D graphics"
    keys = key_frames(time)
    for i, j, share in ((keys[0], keys[1], 0.3), (keys[40], keys[41], 0.9), (keys[-1], keys[-1], 0.0)):
        seek(page, time[i] + share * (time[j] - time[i]))
        for name, motion in rollouts.items():
            ends = [robot.positions(motion.q[k]) for k in (i, j)]
            q = robot.configuration(ends[0] + share * (ends[1] - ends[0]))
            for link in links:
                error = np.abs(link_pose(page, name, link) - robot.pose(q, robot.frame(link))).max()
                assert error <= POSES, f"{name}, {link}, sample {i} + {share}: {error:.1e}"


def test_a_page_plays_and_is_moved_by_keys_and_the_curve(robot_of, page_of):
    """A page plays once when it opens, unless reduced motion is requested. Keys and the curve change its time; clock
    and legend show the time and the manipulability there.
    """
    robot = robot_of("planar3")
    short = page_of(robot, {"plan": waving(robot, 1.0)}, page={"reduced_motion": "no-preference"})
    wait_until(short, "manipLearn.time > 0.0 && !manipLearn.playing")
    assert short.evaluate("manipLearn.time") == short.evaluate("manipLearn.duration") == pytest.approx(1.0)
    motion = waving(robot, 20.0)
    page = page_of(robot, {"a": motion})
    assert page.evaluate("[manipLearn.playing, manipLearn.time]") == [False, 0.0]
    second = motion.time[key_frames(motion.time)[1]]
    for key, expected in (("ArrowRight", second), ("End", 20.0), ("Home", 0.0), ("Shift+ArrowRight", 1.0)):
        page.keyboard.press(key)
        assert page.evaluate("manipLearn.time") == pytest.approx(expected, abs=1e-9), key
    for playing in (True, False):
        page.keyboard.press("Space")
        assert page.evaluate("manipLearn.playing") is playing
    box = page.locator("#chart").bounding_box()
    page.mouse.click(box["x"] + 58 + 0.75 * (box["width"] - 72), box["y"] + 40)
    assert (t := page.evaluate("manipLearn.time")) == pytest.approx(15.0, abs=0.1)
    expected = float(np.interp(t, motion.time, motion.manipulability))
    assert float(page.locator("#legend .mu").inner_text().split()[0]) == float(f"{expected:.2g}")
    assert page.locator("#clock").inner_text() == f"{t:.2f} s"


def test_hostile_names_do_nothing(tmp_path, page_of):
    """Markup in names shows as text; no script of it runs; such links are found."""
    robot = evil_robot(tmp_path)
    motion = waving(robot)
    page = page_of(robot, {EVIL: replace(motion, status=(EVIL,) * len(motion))}, title=EVIL)
    for place in ("#robot-name", "#subtitle", "#legend .name"):
        assert page.locator(place).inner_text() == EVIL
    span = f"0.00 s to {motion.time[-1]:.2f} s"
    assert page.locator("#chart rect title").all_text_contents() == [f"{EVIL}: slowed ({EVIL}), {span}"]
    np.testing.assert_allclose(link_pose(page, EVIL, EVIL), robot.pose(motion.q[0], robot.frame(EVIL)), atol=POSES)
    phased = page_of(robot, {EVIL: motion.trajectory(EVIL)}, phases=[(EVIL, 0.0, 2.0, 0)], mechanism=HINGE)
    assert phased.locator("#mechanism").inner_text() == f"Mechanism: a hinge {EVIL}"
    for each in (page, phased):
        assert each.evaluate("window.hacked") is None and each.locator("img").count() == 0


def test_phases_evidence_and_notes_are_shown(robot_of, page_of):
    """Phases are bands with their names, and the one at the present time is named. The learning report, its warnings,
    odd recordings and notes can be read, and the drawn target and mechanism can be hidden.
    """
    robot = robot_of("planar3")
    learnt = ml.Constraint(np.eye(2), ml.FrameJacobian(robot, "tip", "x y"))
    shown = {"a": waving(robot, 4.0).trajectory("a"), "b": waving(robot, 2.0, phase=1.0).trajectory("b")}
    report = {"sentence": "the hand is held", "warnings": ["recordings are few"], "facts": {"gap": "3,940"}}
    report["odd_trajectories"] = [["b", "moves 3 mm"]]
    more = {"phases": PHASES, "mechanism": HINGE, "constraint": (learnt, learnt), "report": report}
    page = page_of(robot, shown, target=[0.4, 0.3], notes=["a note"], **more)
    titles = page.locator("#chart .bands rect title").all_text_contents()
    labels = ["free motion", "constraint 1", "constraint 2", "constraint 2"]
    assert [title.split(": ")[1].split(",")[0] for title in titles] == labels
    for t, words in ((0.2, "a: not classified"), (0.7, "a: free motion"), (1.0, "a: constraint 1: hinge")):
        seek(page, t)
        assert page.locator("#phase").inner_text() == words
    assert page.locator("#legend .name").all_inner_texts() == ["a", "b odd"]
    body = page.locator("body").text_content()
    assert all(words in body for words in ("the hand is held", "recordings are few", "3,940", "moves 3 mm", "a note"))
    page.locator("#shown summary").click()
    for name in ("constraint", "target"):
        before = picture(page)
        page.locator(f"[data-shown={name}]").click()
        assert picture(page) != before, name


# a check box or a choice is hit by its label
# one of the lists and cards open, the others closed; a number beyond them closes all


def shown_drawer(robot):
    """A drawer as it is learnt from recordings that took hold where the hand is at START, and pulled it towards -x."""
    hold = robot.position(START, robot.frame(TIP))
    free = ml.Mechanism("line", [-1.0, 0.0, 0.0])
    path, times = np.linspace(0.0, 0.12, 20)[:, None], np.linspace(0.0, 1.2, 20)
    numbers = 0.12, 0.0, 0.12, 0.12, 0.12, 0.1, 1.2
    shown = Shown("m", *numbers, True, 5, hold, 0.0, path, times, hold, np.eye(3), 0.0, True, free)
    line = {"type": "line", "axis": [1.0, 0.0, 0.0], "point": hold.tolist(), "sentence": "a line along x"}
    kept = {"mechanism": line, "shown": shown.to_dict(), "kind": "motion-constrained", "n_constraints": 2}
    return ml.Constraint([[0, 1, 0], [0, 0, 1]], ml.FrameJacobian(robot, TIP), kept), hold


def test_a_live_view_follows_and_draws_constraint_and_target(robot_of, opened):
    """The browser shows the latest posture; the mechanism and the target are drawn in the robot's base. A constraint of
    another robot is refused.
    """
    robot = robot_of("sawyer")
    constraint, hold = shown_drawer(robot)
    goal = robot.pose(START, robot.frame(TIP))
    with LiveViewer(robot, constraint=constraint, target=goal, open_browser=False) as viewer:
        page = opened(viewer.url)
        for t, q in ((10.3, START + 0.3), (9.9, START)):
            viewer.show(q, manipulability=t, time=t)
            wait_until(page, f"Math.abs(manipLearn.time - {t}) < 1e-9")
            np.testing.assert_allclose(link_pose(page, robot.name, TIP), robot.pose(q, robot.frame(TIP)), atol=POSES)
        data = page.evaluate("JSON.parse(document.getElementById('data').textContent)")
        np.testing.assert_allclose(data["rollouts"][0]["marks"][0]["target"]["point"], hold, atol=1e-9)
        assert [m["type"] for m in data["mechanisms"]] == ["line"] and data["floor"] == 0.0
    with pytest.raises(ConstraintMismatchError):
        LiveViewer(robot_of("planar3"), constraint=constraint, open_browser=False)


def test_values_and_marks_are_the_librarys(robot_of, drawer, rollout, page_of):
    """Every curve of every track, directions held and free, and semi-axes that are the singular values."""
    robot = robot_of("sawyer")
    slipping = replace(rollout, following_error=np.linspace(0.0, 0.02, len(rollout)) ** 2)
    page = page_of(robot, {"a": slipping})
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
        seek(page, t)
        shown = page.evaluate("manipLearn.trackValues(manipLearn.time)")
        marks = page.evaluate("manipLearn.marks('a', manipLearn.time)")
        assert shown.keys() == tracks.keys()
        for kind, curves in tracks.items():
            expected = {name: np.interp(t, rollout.time, values) for name, values in curves.items()}
            assert shown[kind]["a"] == pytest.approx(expected, rel=1e-5, abs=1e-6), f"{kind} at {t} s"
        A = interp1d(rollout.time, [drawer(q) @ drawer(q).T for q in rollout.q], axis=0)(t)
        axes = np.sqrt(np.maximum(np.linalg.eigvalsh(drawer.selection.T @ A @ drawer.selection)[::-1], 0.0))
        np.testing.assert_allclose([axis["length"] for axis in marks["ellipsoid"]], axes, atol=2e-4)
        held, (free,) = np.array(marks["held"]), np.array(marks["free"])
        np.testing.assert_allclose(held @ held.T, np.eye(2), atol=1e-6)
        np.testing.assert_allclose(held.T @ held, drawer.selection.T @ drawer.selection, atol=1e-6)
        np.testing.assert_allclose(drawer.selection @ free, 0.0, atol=1e-6)


@pytest.fixture(scope="module")
def ways(robot_of):
    """A drawer opened as it was shown, by a hand that comes from aside, and shut again; and where it took hold."""
    constraint, hold = shown_drawer(robot_of("sawyer"))
    robot, done = constraint.robot, {}
    away = robot.positions(START) + [0.1, -0.1, 0.0, 0.1, 0.0, 0.0, 0.0]
    for name, task in (("as shown", ml.motion(constraint)), ("back", ml.motion(constraint, 0.08, direction="back"))):
        law = ml.ResolvedRateController(constraint, task, task.ascent())
        done[name] = simulate_way(robot, law, away, 0.01)[0]
    return robot, done, hold


def test_the_handle_moves_and_the_result_is_shown(ways, page_of):
    """The handle is drawn where the hand grasps and moves it. Legend, mechanism and table say where the hand grasped
    and how far it moved.
    """
    robot, done, hold = ways
    page = page_of(robot, done, 1280, 800)
    for k, (name, distances) in enumerate({"as shown": (0.0, 0.12), "back": (0.08, 0.0)}.items()):
        page.locator("#legend .pick").nth(k).click()
        for t, distance in zip((0.0, 9.0), distances, strict=True):
            seek(page, t)
            handle = page.evaluate("name => manipLearn.handle(name)", name)
            np.testing.assert_allclose(handle, hold - [distance, 0.0, 0.0], atol=2e-3, err_msg=f"{name} {t}")
        value = page.evaluate("name => manipLearn.trackValues(manipLearn.duration).opening[name]", name).get("")
        assert f"moved {value:.3f} m" in page.locator("#legend .state").nth(k).inner_text()
    assert "took hold at the same place, moved 0.12 m" in page.locator("#mechanism").inner_text()
    page.locator("#done summary").click()
    table = page.locator("#done table").inner_text()
    for words in (*done, ", ".join(f"{x:.3f}" for x in hold)[:12], "0.12 of 0.12 m", "of its limit"):
        assert words in table


def test_two_panes_on_one_clock(ways, page_of):
    """Each pane has its caption; the clock is zero where the hand grasps in both; the address opens a moment and a
    view, and the picture can be saved. An impossible alignment is refused.
    """
    robot, done, _ = ways
    page = page_of(robot, done, view="#t=0.4&view=top", side_by_side=True, align="grasp")
    grasp = max(rollout.ways[0]["begins"] for rollout in done.values())
    assert page.evaluate("manipLearn.time") == pytest.approx(grasp + 0.4)
    assert page.locator("#clock").inner_text() == "0.40 s"
    captions = page.locator(".panes p").all_inner_texts()
    for name, distance, caption in zip(done, ("0.12", "0.08"), captions, strict=True):
        assert caption.startswith(name) and f"{distance} of {distance} m" in caption
    with page.expect_download() as download:
        page.locator("#save").click()
    assert download.value.path().read_bytes()[:4] == b"\x89PNG"
    for wrong in ({"align": "contact"}, {"side_by_side": True}):
        with pytest.raises(RecordingError, match="align|side_by_side"):
            page_of(robot, {"a": done["back"]}, **wrong)


# triangles and draw calls of each frame, shadows and all panes included


def test_without_3d_graphics_the_page_explains_what_to_do(robot_of, page_of):
    """Without WebGL the page gives advice, and its clock and curves still work."""
    robot, without = robot_of("planar3"), {"before": "HTMLCanvasElement.prototype.getContext = () => null"}
    page = page_of(robot, {"a": waving(robot, 3.0)}, page=without)
    assert not page.evaluate("manipLearn.drawing")
    assert "hardware acceleration" in page.locator("#no-webgl").inner_text()
    page.evaluate("manipLearn.seek(1)")
    assert page.locator("#clock").inner_text() == "1.00 s" and page.locator("#chart .curve").count() == 1
