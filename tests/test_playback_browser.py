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
from manip_learn.cli import main as manip_learn
from manip_learn.constraint.shown import Shown
from manip_learn.control.simulation import simulate_way
from manip_learn.errors import ConstraintMismatchError, RecordingError
from manip_learn.playback import LiveViewer
from manip_learn.playback.palette import COLOURS
from manip_learn.playback.recorded_motion import key_frames

pytestmark = pytest.mark.browser
# ruff: noqa: F811  fixtures of another file are arguments here
READY = "window.manipLearnReady === true"
TIP = "right_gripper_tip"
POSES = 1e-9  # 1e-6 is required; the page computes in double precision
BETWEEN = [0.0, 0.1, 0.105, 0.4637, 0.73, 0.999, 1.0]  # at key frames, at other samples, between samples
PHASES = [("a", 0.5, 1.0, None), ("a", 1.0, 3.0, 0), ("a", 3.0, 3.5, 1), ("b", 0.0, 2.0, 1)]
LABELS = ["free motion", "constraint 1", "constraint 2", "constraint 2"]
HINGE = {"type": "hinge", "axis": [0, 0, 1], "point": [0.5, 0.5, 0.1], "radius": 0.6, "sentence": f"a hinge {EVIL}"}
REPORT = {"sentence": "the hand is held", "facts": {"gap": "3,940 (10 is clear)"}, "warnings": ["recordings are few"]}


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
    wait_for_frames(page)


def picture(page):
    """The scene at rest alone, as PNG."""
    wait_for_frames(page)
    wait_until(page, "manipLearn.fullFrame")
    return page.locator("#scene canvas").screenshot(style="#legend, #notes, #scene-key, .sheet { visibility: hidden }")


def boxes(page, selector):
    """Text or id, and box, of the controls that can be seen."""
    return page.evaluate(
        """selector => [...document.querySelectorAll(selector)].filter(e => e.checkVisibility()).map(e => {
            const box = e.getBoundingClientRect();
            return [e.id || e.textContent.trim(), box.left, box.right, box.width, box.height];
        })""",
        selector,
    )


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


@pytest.fixture
def page_of(tmp_path, opened):
    """Opens the page of a replay."""
    count = iter(range(99))

    def of(robot, shown, *size, view="", page=None, **more):
        made = ml.replay(robot, shown, tmp_path / f"{next(count)}.html", open_browser=False, **more).html.as_uri()
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
    spans = [(i, j, share) for i, j, share in zip(keys[:-1:40], keys[1::40], (0.0, 0.3, 0.9, 0.0, 0.5), strict=False)]
    for i, j, share in [*spans, (keys[-1], keys[-1], 0.0)]:
        seek(page, time[i] + share * (time[j] - time[i]))
        for which, motion in rollouts.items():
            ends = [robot.positions(motion.q[k]) for k in (i, j)]
            q = robot.configuration(ends[0] + share * (ends[1] - ends[0]))
            for link in links:
                error = np.abs(link_pose(page, which, link) - robot.pose(q, robot.frame(link))).max()
                assert error <= POSES, f"{which}, {link}, sample {i} + {share}: {error:.1e}"


def test_time_obeys_keys_speed_and_curve(robot_of, page_of):
    """A page plays by itself unless motion is unwelcome, and once; pausing holds it; keys, speed, the scrub bar and a
    drag on the curve move it; a button that was clicked keeps no keys.
    """
    robot = robot_of("planar3")
    short = page_of(robot, {"plan": waving(robot, 1.0)}, page={"reduced_motion": "no-preference"})
    wait_until(short, "manipLearn.time > 0.0")
    wait_until(short, "!manipLearn.playing")
    assert short.evaluate("manipLearn.time") == short.evaluate("manipLearn.duration") == pytest.approx(1.0)
    said = short.locator("body").inner_text()
    assert "plan" in said and not any(colour in said for colour in COLOURS)
    motion = waving(robot, 20.0)
    page = page_of(robot, {"a": motion})
    now = lambda: page.evaluate("manipLearn.time")  # noqa: E731
    assert page.evaluate("[manipLearn.playing, manipLearn.time]") == [False, 0.0]
    keys = motion.time[key_frames(motion.time)]
    for key, expected in (
        *(("Home", 0.0), ("ArrowRight", keys[1]), ("ArrowRight", keys[2]), ("ArrowRight", keys[3])),
        *(("ArrowLeft", keys[2]), ("Shift+ArrowRight", keys[2] + 1.0), ("End", 20.0), ("ArrowLeft", keys[-2])),
    ):
        page.keyboard.press(key)
        assert now() == pytest.approx(expected, abs=1e-9), key
    page.locator("[data-view=top]").click()
    page.keyboard.press("Home")
    for playing in (True, False):
        page.keyboard.press("Space")
        assert page.evaluate("manipLearn.playing") is playing
    page.keyboard.press("ArrowUp")
    assert page.locator("#speed").input_value() == "2"
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


@pytest.fixture
def everything(robot_of, page_of):
    """Opens a page that has all that a page can have."""
    robot = robot_of("planar3")
    guided = ml.Constraint(np.eye(2), ml.FrameJacobian(robot, "tip", "x y"))
    moves = {"a": waving(robot, 4.0), "b": waving(robot, 2.0, phase=1.0)}
    shown = {n: ml.Trajectory(m.time, m.q, np.gradient(m.q, m.time, axis=0), name=n) for n, m in moves.items()}
    notes = ["a note about a_very_long_file_name_that_has_no_space_in_it_and_goes_on_and_on.mcap"]
    report = {**REPORT, "odd_trajectories": [["b", "moves 3 mm"]]}
    more = {"phases": PHASES, "mechanism": HINGE, "constraint": (guided, guided), "report": report, "notes": notes}
    return lambda *size, **page: page_of(robot, shown, *size, target=[0.4, 0.3], title="drawer", page=page, **more)


def test_phases_are_bands_at_their_times(everything):
    """Bands are named while playing; the slider obeys. They change to how
    well each sample fits, and back. Nothing keeps readers out, light and dark, with all that can be shown.
    """
    page = everything()
    titles = page.locator("#chart .bands rect title").all_text_contents()
    assert [title.split(": ")[1].split(",")[0] for title in titles] == [label.split(":")[0] for label in LABELS]
    for t, words in ((0.2, "a: not classified"), (0.7, "a: free motion"), (1.0, "a: constraint 1: hinge")):
        seek(page, t)
        assert page.locator("#phase").inner_text() == words
    band, slider = page.locator("#scrub-bands rect").nth(1).bounding_box(), page.locator("#scrub").bounding_box()
    page.mouse.click(band["x"], slider["y"] + slider["height"] / 2)
    assert page.evaluate("manipLearn.time") == pytest.approx(1.0, abs=0.03)
    rows, key = page.locator("#chart .bands"), page.locator("#status-key")
    before = rows.nth(1).inner_html()
    page.locator("#shown summary").click()
    page.locator("[name=colours][value=fit]").check()
    assert "100 %" in key.inner_text() and rows.nth(1).inner_html() != before
    page.locator("[name=colours][value=phase]").check()
    assert rows.nth(1).inner_html() == before
    assert page.locator("#legend .name").all_inner_texts() == ["a", "b odd"]
    page.evaluate(ALL_TRACKS)
    page.evaluate("document.querySelectorAll('details').forEach(list => { list.open = true; })")
    keeps_no_reader_out(page)


FINGER = 40  # least width and height of what a finger must hit [px]
# a check box or a choice is hit by its label
CONTROLS = "button, select, summary, input[type=range], label:has(input)"
ALL_TRACKS = "document.querySelectorAll('#sheets input').forEach(box => { if (!box.checked) box.click(); })"
# one of the lists and cards open, the others closed; a number beyond them closes all
OPEN_ONE = "n => document.querySelectorAll('details').forEach((list, i) => { list.open = i === n; })"


def test_phones_show_everything_without_sideways_scrolling(everything):
    """On a phone nothing is wider than the screen, and every control is large enough for a finger; robot and curve are
    there before anything is scrolled, names and notes below.
    """
    width = 390
    page = everything(width, 844, phone=True)
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
    """The browser shows the posture that was given last; the mechanism and the target stand in the robot's base, the
    floor at its foot; a constraint of another robot is refused.
    """
    robot = robot_of("sawyer")
    constraint, hold = shown_drawer(robot)
    goal = robot.pose(START, robot.frame(TIP))
    with LiveViewer(robot, constraint=constraint, target=goal, open_browser=False) as viewer:
        page = opened(viewer.url)
        bare = picture(page)
        for t, q in ((10.3, START + 0.3), (9.9, START)):
            viewer.show(q, manipulability=t, time=t)
            wait_until(page, f"Math.abs(manipLearn.time - {t}) < 1e-9")
            np.testing.assert_allclose(link_pose(page, robot.name, TIP), robot.pose(q, robot.frame(TIP)), atol=POSES)
        data = page.evaluate("JSON.parse(document.getElementById('data').textContent)")
        np.testing.assert_allclose(data["rollouts"][0]["marks"][0]["target"]["point"], hold, atol=1e-9)
        assert [m["type"] for m in data["mechanisms"]] == ["line"] and data["floor"] == 0.0
        assert picture(page) != bare
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


def test_tracks_marks_and_cards_are_switched(drawer, rollout, page_of):
    """A box of a track adds it with its values; each box of the scene changes the picture; one card is open at a time,
    and escape closes it.
    """
    kept = ml.Constraint(drawer.selection, drawer.features, REPORT)
    page = page_of(drawer.features.robot, {"a": rollout}, constraint=kept)
    page.locator("#track-choice summary").click()
    page.locator("[data-track=singular]").check()
    page.keyboard.press("Escape")
    assert not page.locator("#track-choice section").is_visible() and page.locator("#tracks .track").count() == 1
    page.locator("#shown summary").click()
    for name in ("constraint", "target", "ellipsoid", "paths"):
        before = picture(page)
        page.locator(f"[data-shown={name}]").click()
        assert picture(page) != before, name
    page.locator("#evidence summary").click()
    wait_until(page, "!document.querySelector('#shown').open", 5.0)
    told = page.locator("#evidence section").inner_text()
    assert "the hand is held" in told and "3,940 (10 is clear)" in told


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


def test_what_was_shown_is_drawn_and_what_was_done_is_told(ways, page_of):
    """A drawer that is shut where recordings took hold is so on every page; legends and the readout say what the curves
    have, a table where the hand took hold, how far, and how well; a dark page has lighter curves.
    """
    robot, done, hold = ways
    page = page_of(robot, done, 1280, 800)
    for k, (name, fars) in enumerate({"as shown": (0.0, 0.12), "back": (0.08, 0.0)}.items()):
        page.locator("#legend .pick").nth(k).click()
        for t, far in zip((0.0, 9.0), fars, strict=True):
            seek(page, t)
            handle = page.evaluate("name => manipLearn.handle(name)", name)
            np.testing.assert_allclose(handle, hold - [far, 0.0, 0.0], atol=2e-3, err_msg=f"{name} {t}")
        value = page.evaluate("name => manipLearn.trackValues(manipLearn.duration).opening[name]", name).get("")
        assert f"moved {value:.3f} m" in page.locator("#legend .state").nth(k).inner_text()
    words = page.locator("#scene-key li:visible").all_inner_texts()
    assert {"free to move", "held", "line that was learnt"} <= set(words)
    assert "took hold at the same place, moved 0.12 m" in page.locator("#mechanism").inner_text()
    page.locator("#done summary").click()
    table = page.locator("#done table").inner_text()
    for told in (*done, ", ".join(f"{x:.3f}" for x in hold)[:12], "0.12 of 0.12 m", "mm", "of its limit"):
        assert told in table
    for scheme, same in (("dark", "!=="), ("light", "===")):
        page.emulate_media(color_scheme=scheme)
        wait_until(page, f"document.querySelector('#chart .curve').getAttribute('stroke') {same} '#0072b2'")


def test_two_panes_on_one_clock(ways, page_of):
    """Each pane has its caption, the clock is zero where the hand takes hold in both; the address opens a moment and a
    view, and the picture is saved.
    """
    robot, done, _ = ways
    page = page_of(robot, done, view="#t=0.4&view=top", side_by_side=True, align="grasp")
    begins = max(rollout.ways[0]["begins"] for rollout in done.values())
    assert page.evaluate("manipLearn.time") == pytest.approx(begins + 0.4)
    assert page.locator("#clock").inner_text() == "0.40 s"
    captions = page.locator(".panes p").all_inner_texts()
    assert [said[: len(name)] for name, said in zip(done, captions, strict=True)] == list(done)
    assert all(f"{far} of {far} m" in said for far, said in zip(("0.12", "0.08"), captions, strict=True))
    with page.expect_download() as saved:
        page.locator("#save").click()
    assert saved.value.path().read_bytes()[:4] == b"\x89PNG"
    for wrong in ({"align": "contact"}, {"side_by_side": True}):
        with pytest.raises(RecordingError, match="align|side_by_side"):
            page_of(robot, {"a": done["back"]}, **wrong)


# triangles and draw calls of each frame, shadows and all panes included
COUNTED = """
window.frames3d = [];
let now = [0, 0];
const count = (mode, corners) => { now[0] += mode === 4 ? corners / 3 : 0; now[1] += 1; };
for (const P of [WebGLRenderingContext.prototype, WebGL2RenderingContext.prototype]) {
  const { drawElements, drawArrays } = P;
  P.drawElements = function (...a) { count(a[0], a[1]); return drawElements.apply(this, a); };
  P.drawArrays = function (...a) { count(a[0], a[2]); return drawArrays.apply(this, a); };
}
const ask = requestAnimationFrame;
window.requestAnimationFrame = (f) => ask((t) => { now = [0, 0]; f(t); if (now[1]) frames3d.push(now); });
"""


def test_a_frame_is_cheap(robot_of, tmp_path, opened, page_of):
    """Of two arms side by side of the demo, or of a solid one and a ghost. Without a graphics card a page draws fewer
    pixels and no shadows while something moves; when it rests, all of it again.
    """
    assert manip_learn(["demo", "--no-browser", "--out", str(tmp_path)]) == 0
    path, robot, counted = tmp_path / "replay.html", robot_of("panda"), {"before": COUNTED}
    assert path.stat().st_size < 2_500_000
    shown = {"a": waving(robot), "b": waving(robot, phase=0.8)}
    canvas = "document.querySelector('#scene canvas').width / document.querySelector('#scene').clientWidth"
    for page, most in (
        (opened(path.as_uri(), 1280, 800, **counted), 150_000),
        (page_of(robot, shown, 1280, 800, page=counted), 300_000),
    ):
        picture(page)
        full = page.evaluate(f"[...frames3d.at(-1), {canvas}]")
        assert 0 < full[0] <= most and 0 < full[1] <= 120
    page.locator("#loop").click()
    page.evaluate("manipLearn.play()")
    wait_until(page, f"!manipLearn.fullFrame && {canvas} < 0.62")
    assert np.all(np.less(page.evaluate("frames3d.at(-1)"), full[:2]))
    page.evaluate("manipLearn.pause()")
    picture(page)
    assert page.evaluate(canvas) == pytest.approx(full[2], abs=0.01) == 2.0


def test_no_3d_graphics_says_what_to_do(robot_of, page_of):
    """Without WebGL the page says what to do, and its curves and numbers still play."""
    robot, without = robot_of("planar3"), {"before": "HTMLCanvasElement.prototype.getContext = () => null"}
    page = page_of(robot, {f"number {i}": waving(robot, 3.0) for i in range(3)}, page=without)
    assert not page.evaluate("manipLearn.drawing")
    words = page.locator("#no-webgl").inner_text()
    assert "WebGL" in words and "hardware acceleration" in words and "another browser" in words
    page.evaluate("manipLearn.seek(1)")
    assert page.locator("#clock").inner_text() == "1.00 s" and page.locator("#chart .curve").count() == 3
