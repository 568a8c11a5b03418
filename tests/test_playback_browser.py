"""The replay page in headless Chromium: what is shown is what the library computes; controls, escaping, no network."""

from __future__ import annotations

from contextlib import ExitStack, contextmanager
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from conftest import BASES
from test_playback import EVIL, evil_robot, waving
from test_replay_tracks import START

import manip_learn as ml
from manip_learn.errors import ConstraintMismatchError
from manip_learn.playback import LiveViewer
from manip_learn.playback.recorded_motion import key_frames

pytestmark = pytest.mark.browser
READY = "window.manipLearnReady === true"
TIP = "right_gripper_tip"
POSES = 1e-9  # 1e-6 is required; the page computes in double precision
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
        yield lambda address, **more: pages.enter_context(browser_page(chromium, address, **more))


def wait_until(page, expression, seconds=60.0):
    """Wait until an expression is true; Playwright's own way to wait needs eval, which the page's policy forbids."""
    for _ in range(round(50 * seconds)):
        if page.evaluate(expression):
            return
        page.wait_for_timeout(20)
    raise AssertionError(f"{expression} is still false")


def link_pose(page, rollout, link):
    """Pose of a link as the page draws it now."""
    rows = page.evaluate("([rollout, link]) => manipLearn.linkPose(rollout, link)", [rollout, link])
    return np.array(rows).reshape(4, 4)


def picture(page):
    """The scene at rest alone, as PNG; two frames later it is drawn."""
    page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    wait_until(page, "manipLearn.fullFrame")
    return page.locator("#scene canvas").screenshot(style="#legend, #notes, #scene-key, .sheet { visibility: hidden }")


@pytest.fixture
def page_of(tmp_path, opened):
    """Opens the page of a replay."""

    def of(robot, shown, page=None, **more):
        made = ml.replay(robot, shown, tmp_path / "a.html", open_browser=False, **more).html.as_uri()
        return opened(made, **(page or {}))

    return of


@pytest.mark.parametrize("name", ["mimic", "wrist", "rover", "humanoid"])
def test_links_are_where_kinematics_puts_them(robot_of, page_of, name):
    """At key frames every link of every rollout is within 1e-9 of forward kinematics, and between them too, unless the
    base moves: its rotations are interpolated in another way.
    """
    robot = robot_of(name)
    frames = robot.pinocchio_model.frames
    links = [n for n in robot.frame_names if frames[robot.frame(n).index].type == pin.FrameType.BODY]
    rollouts = {"one": waving(robot), "two": waving(robot, phase=1.0)}
    page, time = page_of(robot, rollouts), rollouts["one"].time
    assert page.evaluate("manipLearn.drawing"), "the page has no 3D graphics"
    keys, shares = key_frames(time), (0.0, 0.0) if name in BASES else (0.3, 0.9)
    for i, j, share in ((keys[0], keys[1], shares[0]), (keys[40], keys[41], shares[1]), (keys[-1], keys[-1], 0.0)):
        page.evaluate("t => manipLearn.seek(t)", float(time[i] + share * (time[j] - time[i])))
        for rollout, motion in rollouts.items():
            ends = [robot.positions(motion.q[k]) for k in (i, j)]
            q = robot.configuration(ends[0] + share * (ends[1] - ends[0]))
            for link in links:
                error = np.abs(link_pose(page, rollout, link) - robot.pose(q, robot.frame(link))).max()
                assert error <= POSES, f"{rollout}, {link}, sample {i} + {share}: {error:.1e}"


def test_hostile_names_do_nothing(tmp_path, page_of):
    """Markup in names shows as text; no script of it runs; such links are found."""
    robot = evil_robot(tmp_path)
    motion = waving(robot)
    page = page_of(robot, {EVIL: replace(motion, status=(EVIL,) * len(motion))}, title=EVIL)
    for place in ("#robot-name", "#subtitle", "#legend .name"):
        assert page.locator(place).inner_text() == EVIL
    assert f"{EVIL}: slowed ({EVIL}), " in page.locator("#chart rect title").text_content()
    np.testing.assert_allclose(link_pose(page, EVIL, EVIL), robot.pose(motion.q[0], robot.frame(EVIL)), atol=POSES)
    phased = page_of(robot, {EVIL: motion.trajectory(EVIL)}, phases=[(EVIL, 0.0, 2.0, 0)], mechanism=HINGE)
    assert phased.locator("#mechanism").inner_text() == f"Mechanism: a hinge {EVIL}"
    for each in (page, phased):
        assert each.evaluate("window.hacked") is None and each.locator("img").count() == 0


def test_a_page_plays_and_shows_what_was_learnt(robot_of, page_of):
    """A page plays once when it opens, unless reduced motion is requested. It names the present phase, draws the
    mechanism, and has the learning report, its warnings, odd recordings and notes.
    """
    robot, motion = robot_of("planar3"), waving(robot_of("planar3"), 1.0)
    learnt = ml.Constraint(np.eye(2), ml.FrameJacobian(robot, "tip", "x y"))
    report = {"sentence": "the hand is held", "warnings": ["recordings are few"], "facts": {"gap": "3,940"}}
    report["odd_trajectories"] = [["b", "moves 3 mm"]]
    more = {"constraint": learnt, "report": report, "mechanism": HINGE, "notes": ["a note"]}
    shown = {"a": motion.trajectory("a"), "b": motion}
    playing = {"reduced_motion": "no-preference"}
    page = page_of(robot, shown, phases=[("a", 0.0, 0.5, None), ("a", 0.5, 1.0, 0)], page=playing, **more)
    wait_until(page, "manipLearn.time > 0.0 && !manipLearn.playing")
    assert page.evaluate("manipLearn.time") == page.evaluate("manipLearn.duration") == pytest.approx(1.0)
    for t, words in ((0.2, "a: free motion"), (0.7, "a: constraint 1: hinge")):
        page.evaluate("t => manipLearn.seek(t)", t)
        assert page.locator("#phase").inner_text() == words
    assert page.locator("#clock").inner_text() == "0.70 s"
    text = page.locator("body").text_content()
    words = ("the hand is held", "recordings are few", "3,940", "moves 3 mm", "a note")
    assert [word for word in words if word not in text] == []
    page.locator("#shown summary").click()
    before = picture(page)
    page.locator("[data-shown=constraint]").click()
    assert picture(page) != before


def test_a_live_view_follows_and_draws_constraint_and_target(robot_of, opened):
    """The browser shows the latest posture; the mechanism and the target are in the robot's base. A constraint of
    another robot is refused.
    """
    robot = robot_of("sawyer")
    goal = robot.pose(START, robot.frame(TIP))
    line = {"type": "line", "axis": [1.0, 0.0, 0.0], "point": goal[:3, 3].tolist(), "sentence": "a line along x"}
    kept = {"mechanism": line, "kind": "motion-constrained", "n_constraints": 2}
    constraint = ml.Constraint([[0, 1, 0], [0, 0, 1]], ml.FrameJacobian(robot, TIP), kept)
    with LiveViewer(robot, constraint=constraint, target=goal, open_browser=False) as viewer:
        page = opened(viewer.url)
        for t, q in ((10.3, START + 0.3), (9.9, START)):
            viewer.show(q, manipulability=t, time=t)
            wait_until(page, f"Math.abs(manipLearn.time - {t}) < 1e-9")
            np.testing.assert_allclose(link_pose(page, robot.name, TIP), robot.pose(q, robot.frame(TIP)), atol=POSES)
        data = page.evaluate("JSON.parse(document.getElementById('data').textContent)")
        np.testing.assert_allclose(data["rollouts"][0]["marks"][0]["target"]["point"], goal[:3, 3], atol=1e-9)
        assert [m["type"] for m in data["mechanisms"]] == ["line"]
    with pytest.raises(ConstraintMismatchError):
        LiveViewer(robot_of("planar3"), constraint=constraint, open_browser=False)


def test_without_3d_graphics_the_page_explains_what_to_do(robot_of, page_of):
    """Without WebGL the page gives advice, and its clock and curves still work."""
    robot, without = robot_of("planar3"), {"before": "HTMLCanvasElement.prototype.getContext = () => null"}
    page = page_of(robot, {"a": waving(robot, 3.0)}, page=without)
    assert not page.evaluate("manipLearn.drawing")
    assert "hardware acceleration" in page.locator("#no-webgl").inner_text()
    page.evaluate("manipLearn.seek(1)")
    assert page.locator("#clock").inner_text() == "1.00 s" and page.locator("#chart .curve").count() == 1
