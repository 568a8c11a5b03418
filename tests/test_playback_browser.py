"""The replay page in headless Chromium: poses, controls, escaping, no network."""

from __future__ import annotations

import time
import zlib
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from test_playback import EVIL, evil_robot, waving

from manip_learn.playback import LiveViewer, replay
from manip_learn.playback.recorded_motion import key_frames

pytestmark = pytest.mark.browser

POSES = 1e-9  # 1e-6 is required; the page computes in double precision


@pytest.fixture
def opened(chromium):
    """Open a page of ours; whatever goes wrong in it, or wants the network, fails the test in the end."""
    context = chromium.new_context(viewport={"width": 1000, "height": 700})
    trouble: list[str] = []

    def open_page(address, width=1000, height=700):
        page = context.new_page()
        page.set_viewport_size({"width": width, "height": height})
        page.on("pageerror", lambda error: trouble.append(str(error)))
        page.on("console", lambda m: trouble.append(m.text) if m.type == "error" else None)
        page.on(
            "request", lambda r: trouble.append(r.url) if not r.url.startswith((address, "data:", "blob:")) else None
        )
        page.goto(address)
        wait_until(page, "window.manipLearnReady === true")
        return page

    yield open_page
    context.close()
    assert trouble == []


def wait_until(page, expression, seconds=60.0):
    """Wait until an expression is true; Playwright's own way to wait needs eval, which the page's policy forbids."""
    end = time.monotonic() + seconds
    while not page.evaluate(expression):
        assert time.monotonic() < end, f"{expression} is still false"
        page.wait_for_timeout(20)


def link_pose(page, rollout, link):
    """Pose of a link as the page draws it now."""
    rows = page.evaluate("([rollout, link]) => manipLearn.linkPose(rollout, link)", [rollout, link])
    return np.array(rows).reshape(4, 4)


def links_of(robot):
    """Names of all links."""
    frames = robot.pinocchio_model.frames
    return [n for n in robot.frame_names if frames[robot.frame(n).index].type == pin.FrameType.BODY]


@pytest.mark.parametrize("robot_name", ["planar3", "sawyer", "wrist", "humanoid", "rover", "mimic", "panda"])
def test_links_are_where_kinematics_puts_them(robot_of, tmp_path, opened, robot_name):
    """At key frames every link of every rollout is drawn within 1e-9 of forward kinematics (1e-6 is required)."""
    robot = robot_of(robot_name)
    rollouts = {"one": waving(robot), "two": waving(robot, phase=1.0)}
    page = opened(replay(robot, rollouts, tmp_path / "a.html").html.as_uri())
    assert page.evaluate("manipLearn.drawing"), "the page has no 3D graphics"
    keys = key_frames(rollouts["one"].time)
    for i in keys[:: keys.size // 5]:
        page.evaluate("t => manipLearn.seek(t)", float(rollouts["one"].time[i]))
        for name, rollout in rollouts.items():
            for link in links_of(robot):
                error = np.abs(link_pose(page, name, link) - robot.pose(rollout.q[i], robot.frame(link))).max()
                assert error <= POSES, f"{name}, {link}, t = {rollout.time[i]}: {error:.1e}"


def test_huge_angles_are_right(robot_of, tmp_path, opened):
    """A joint that was thrown a thousand million turns away is still drawn as kinematics says."""
    robot = robot_of("planar3")
    rollout = waving(robot)
    q = np.array(rollout.q)
    q[100:] += [6.1e9, 0.0, -2.7e8]
    far = replace(rollout, q=q)
    page = opened(replay(robot, {"far": far}, tmp_path / "a.html").html.as_uri())
    page.evaluate("manipLearn.seek(manipLearn.duration)")
    error = np.abs(link_pose(page, "far", "tip") - robot.pose(q[-1], robot.frame("tip"))).max()
    assert error <= 1e-6


def test_shorter_rollouts_hold_their_last_pose(robot_of, tmp_path, opened):
    """After its end a rollout stays where it ended, and the legend says so."""
    robot = robot_of("sawyer")
    rollouts = {"long": waving(robot, 3.0), "short": waving(robot, 1.0, phase=0.5)}
    page = opened(replay(robot, rollouts, tmp_path / "a.html").html.as_uri())
    assert page.evaluate("manipLearn.duration") == pytest.approx(3.0)
    page.evaluate("manipLearn.seek(2.5)")
    expected = robot.pose(rollouts["short"].q[-1], robot.frame("right_hand"))
    np.testing.assert_allclose(link_pose(page, "short", "right_hand"), expected, atol=POSES)
    states = page.locator("#legend .state").all_inner_texts()
    assert "ended at 1.00 s" in states[1] and "ended" not in states[0]


def test_play_pause_and_keys(robot_of, tmp_path, opened):
    """Playing takes time on and pausing holds it; space, arrows, home and end, speed and the scrub bar work."""
    robot = robot_of("planar3")
    rollout = waving(robot, 20.0)
    page = opened(replay(robot, {"a": rollout}, tmp_path / "a.html").html.as_uri())
    now = lambda: page.evaluate("manipLearn.time")  # noqa: E731
    page.evaluate("manipLearn.play()")
    wait_until(page, "manipLearn.time > 0.1")
    page.evaluate("manipLearn.pause()")
    held = now()
    page.wait_for_timeout(150)
    assert now() == held > 0.0
    keys = rollout.time[key_frames(rollout.time)]
    page.keyboard.press("Home")
    for i in (1, 2, 3):
        page.keyboard.press("ArrowRight")
        assert now() == keys[i]
    page.keyboard.press("ArrowLeft")
    assert now() == keys[2]
    page.keyboard.press("Shift+ArrowRight")
    assert now() == pytest.approx(keys[2] + 1.0)
    page.keyboard.press("End")
    assert now() == pytest.approx(20.0)
    page.keyboard.press("ArrowLeft")
    assert now() == keys[-2]
    page.keyboard.press("Space")
    assert page.evaluate("manipLearn.playing")
    page.keyboard.press("Space")
    assert not page.evaluate("manipLearn.playing")
    page.keyboard.press("ArrowUp")
    assert page.locator("#speed").input_value() == "2"
    assert page.locator("#speed option").all_inner_texts() == ["0.1×", "0.25×", "0.5×", "1×", "2×", "4×"]
    page.locator("#scrub").fill("7.5")
    assert now() == pytest.approx(7.5, abs=0.05)


def test_speed_changes_the_pace(robot_of, tmp_path, opened):
    """At 4x the replay covers far more time than at 0.1x in the same span."""
    robot = robot_of("planar3")
    page = opened(replay(robot, {"a": waving(robot, 60.0)}, tmp_path / "a.html").html.as_uri())
    covered = {}
    for speed in ("0.1", "4"):
        page.evaluate("manipLearn.seek(0)")
        page.locator("#speed").select_option(speed)
        page.evaluate("manipLearn.play()")
        wait_until(page, "manipLearn.time > 0")
        page.wait_for_timeout(700)
        covered[speed] = page.evaluate("manipLearn.time")
        page.evaluate("manipLearn.pause()")
    assert covered["4"] > 8.0 * covered["0.1"] > 0.0


def test_curve_scrubs(robot_of, tmp_path, opened):
    """A click or a drag on the curve moves the replay there; the cursor and the readouts follow."""
    robot = robot_of("planar3")
    rollout = waving(robot, 4.0)
    page = opened(replay(robot, {"a": rollout}, tmp_path / "a.html").html.as_uri())
    box = page.locator("#chart").bounding_box()
    left, right, y = box["x"] + 58, box["x"] + box["width"] - 14, box["y"] + 40
    page.mouse.move(left + 0.25 * (right - left), y)
    page.mouse.down()
    assert page.evaluate("manipLearn.time") == pytest.approx(1.0, abs=0.02)
    page.mouse.move(left + 0.75 * (right - left), y)
    page.mouse.up()
    t = page.evaluate("manipLearn.time")
    assert t == pytest.approx(3.0, abs=0.02)
    expected = float(np.interp(t, rollout.time, rollout.manipulability))
    assert float(page.locator("#legend .mu").inner_text().split()[0]) == pytest.approx(expected, rel=1e-2)
    assert page.locator("#clock").inner_text() == f"{t:.2f} s"
    cursor = page.locator("#chart line[stroke-width='1.5']").get_attribute("x1")
    assert float(cursor) + box["x"] == pytest.approx(left + 0.75 * (right - left), abs=3.0)


def test_legend_hides_and_picks(robot_of, tmp_path, opened):
    """The legend's switches change the picture and the curves, and bring them back; a click on a name makes solid."""
    robot = robot_of("planar3")
    rollouts = {"a": waving(robot), "b": waving(robot, phase=2.0)}
    page = opened(replay(robot, rollouts, tmp_path / "a.html").html.as_uri())

    def picture():
        page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        return page.locator("#scene canvas").screenshot(style="#legend, #notes { visibility: hidden }")

    page.evaluate("manipLearn.seek(1.3)")
    both = picture()
    assert page.locator("#chart polyline").count() == 2
    page.locator("#legend .eye").nth(1).click()
    assert picture() != both
    assert page.locator("#chart polyline").count() == 1
    page.locator("#legend .eye").nth(1).click()
    assert picture() == both
    page.locator("#legend .pick").nth(1).click()
    assert picture() != both
    page.locator("#legend .pick").nth(0).click()
    assert picture() == both
    page.evaluate("manipLearn.seek(0.2)")
    assert picture() != both


def test_hostile_names_do_nothing(tmp_path, opened):
    """Markup in names shows as text; no script of it runs; links with such names are found."""
    robot = evil_robot(tmp_path)
    rollout = waving(robot)
    evil = replace(rollout, status=(EVIL,) * len(rollout))
    page = opened(replay(robot, {EVIL: evil}, tmp_path / "a.html", title=EVIL).html.as_uri())
    assert page.evaluate("window.hacked") is None
    for place in ("#robot-name", "#subtitle", "#legend .name"):
        assert page.locator(place).inner_text() == EVIL
    assert EVIL in page.locator("#status-key").inner_text()
    assert page.locator("img").count() == 0
    expected = robot.pose(rollout.q[0], robot.frame(EVIL))
    np.testing.assert_allclose(link_pose(page, EVIL, EVIL), expected, atol=POSES)


@pytest.mark.parametrize(("width", "height"), [(800, 600), (1280, 800), (1920, 1080)])
def test_page_fits_the_window(robot_of, tmp_path, opened, width, height):
    """From 800 pixels on, nothing sticks out of the window and every control is inside."""
    robot = robot_of("planar3")
    rollouts = {f"a rather long name of a rollout, number {i}": waving(robot, phase=i) for i in range(4)}
    page = opened(replay(robot, rollouts, tmp_path / "a.html", title="a title " * 20).html.as_uri(), width, height)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.evaluate("document.documentElement.scrollHeight") <= height
    for selector in ("#views", "#legend", "#chart", "#play", "#scrub", "#speed", "#loop", "#log", "#keys summary"):
        box = page.locator(selector).bounding_box()
        assert box["x"] >= 0 and box["x"] + box["width"] <= width, selector
        assert box["y"] >= 0 and box["y"] + box["height"] <= height, selector


def test_crowds_and_single_samples(robot_of, tmp_path, opened):
    """Thirty rollouts still fit the window, those beyond twelve are drawn once picked; one sample is a replay, too."""
    robot = robot_of("planar3")
    crowd = {str(i): waving(robot, phase=0.2 * i) for i in range(30)}
    result = replay(robot, crowd, tmp_path / "a.html")
    assert "first 12 are drawn" in result.notes[0]
    page = opened(result.html.as_uri(), 800, 600)
    assert page.evaluate("document.documentElement.scrollHeight") <= 600
    assert page.locator("#chart rect").count() < 100
    page.locator("#legend .pick").nth(25).click()
    page.evaluate("manipLearn.seek(1)")
    np.testing.assert_allclose(
        link_pose(page, "25", "tip"), robot.pose(crowd["25"].q[100], robot.frame("tip")), atol=POSES
    )
    still = waving(robot, 0.0)
    page = opened(replay(robot, {"still": still}, tmp_path / "b.html").html.as_uri())
    page.keyboard.press("Space")
    page.keyboard.press("ArrowRight")
    assert page.evaluate("manipLearn.time") == 0.0
    np.testing.assert_allclose(link_pose(page, "still", "tip"), robot.pose(still.q[0], robot.frame("tip")), atol=POSES)


def test_curves_can_be_absent(robot_of, tmp_path, opened):
    """A demonstration plays without a panel for curves that it does not have."""
    robot = robot_of("sawyer")
    demo = waving(robot).trajectory("demo")
    page = opened(replay(robot, demo, tmp_path / "a.html").html.as_uri())
    assert not page.locator("#panel").is_visible()
    assert page.locator("#scene canvas").is_visible()


PHASES = [("a", 0.5, 1.0, None), ("a", 1.0, 3.0, 0), ("a", 3.0, 3.5, 1), ("b", 0.0, 2.0, 1)]


def phased_page(robot, folder, opened, **more):
    """Two recordings of 4 s and 2 s with phases, opened."""
    recordings = {"a": waving(robot, 4.0).trajectory("a"), "b": waving(robot, 2.0, phase=1.0).trajectory("b")}
    return opened(replay(robot, recordings, folder / "a.html", phases=PHASES, **more).html.as_uri())


def test_phases_are_bands_at_their_times(robot_of, tmp_path, opened):
    """Each phase is a band from its start to its end on the chart's own axis, in the colour of the legend."""
    page = phased_page(robot_of("planar3"), tmp_path, opened)
    colours = dict(zip(["constraint 1", "constraint 2", "free motion"], ["#0072b2", "#d55e00", "#8a95a0"], strict=True))
    bars = page.evaluate(
        """() => [...document.querySelectorAll("#chart .bands rect")].map(r => {
            const box = r.getBoundingClientRect();
            return [box.left, box.right, r.getAttribute("fill"), r.querySelector("title").textContent];
        })"""
    )
    expected = ["free motion", "constraint 1", "constraint 2", "constraint 2"]
    assert len(bars) == len(PHASES)
    for (left, right, fill, title), (name, start, end, _), label in zip(bars, PHASES, expected, strict=True):
        assert (fill, title) == (colours[label], f"{name}: {label}, {start:.2f} s to {end:.2f} s")
        for x, t in ((left, start), (right, end)):
            page.evaluate("t => manipLearn.seek(t)", t)
            cursor = page.locator("#chart line[stroke-width='1.5']").bounding_box()
            assert x == pytest.approx(cursor["x"] + cursor["width"] / 2, abs=1.5)
    key = page.locator("#status-key span").all_inner_texts()
    assert [text.strip().split("\n")[-1] for text in key] == [*colours, "not classified"]
    assert page.locator("#panel-title").inner_text() == "Phases"
    assert not page.locator("#log").is_visible()


def test_band_has_its_colour_on_the_screen(robot_of, tmp_path, opened):
    """What is seen at the middle of a band and of the slider's band is the constraint's colour, in a screenshot."""
    page = phased_page(robot_of("planar3"), tmp_path, opened)
    for place in ("#chart .bands rect", "#scrub-bands rect"):
        box = page.locator(place).nth(1).bounding_box()
        assert pixel(page, box["x"] + box["width"] * 0.6, box["y"] + box["height"] / 2) == (0x00, 0x72, 0xB2)


def pixel(page, x, y):
    """Colour of one pixel of a screenshot, decoded by the browser."""
    shot = page.screenshot(clip={"x": int(x), "y": int(y), "width": 1, "height": 1})
    return tuple(decoded(shot))


def decoded(png):
    """The first pixel of a PNG of 8-bit RGB or RGBA: after its filter byte, which changes nothing in a first pixel."""
    data, at = b"", 8
    while at < len(png):
        length = int.from_bytes(png[at : at + 4], "big")
        if png[at + 4 : at + 8] == b"IDAT":
            data += png[at + 8 : at + 8 + length]
        at += 12 + length
    return zlib.decompress(data)[1:4]


def test_phase_is_named_while_playing(robot_of, tmp_path, opened):
    """The phase at the cursor is named for the solid recording, and for each in the legend; none after the end."""
    page = phased_page(robot_of("planar3"), tmp_path, opened)
    expected = [
        (0.2, "not classified", "constraint 2"),
        (0.7, "free motion", "constraint 2"),
        (1.0, "constraint 1", "constraint 2"),
        (3.2, "constraint 2", "ended at 2.00 s"),
    ]
    for t, first, second in expected:
        page.evaluate("t => manipLearn.seek(t)", t)
        assert page.locator("#phase").inner_text() == f"a: {first}"
        assert page.locator("#legend .state").all_inner_texts() == [first, second]
    page.evaluate("manipLearn.seek(0.5)")
    page.locator("#legend .pick").nth(1).click()
    assert page.locator("#phase").inner_text() == "b: constraint 2"
    assert page.locator("#scrub-bands rect").count() == 1


def test_slider_bands_are_where_the_thumb_is(robot_of, tmp_path, opened):
    """A click on the slider at the edge of a band moves the replay to the time of that edge."""
    page = phased_page(robot_of("planar3"), tmp_path, opened)
    band, slider = page.locator("#scrub-bands rect").nth(1).bounding_box(), page.locator("#scrub").bounding_box()
    page.mouse.click(band["x"], slider["y"] + slider["height"] / 2)
    assert page.evaluate("manipLearn.time") == pytest.approx(1.0, abs=0.03)


def test_mechanism_is_drawn_and_told(robot_of, tmp_path, opened):
    """The mechanism changes the picture, and its words are in the legend as text."""
    hinge = {"type": "hinge", "axis": [0, 0, 1], "point": [0.5, 0.5, 0.1], "radius": 0.6, "sentence": f"a hinge {EVIL}"}
    robot = robot_of("planar3")

    def picture(page):
        page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        return page.locator("#scene canvas").screenshot(style="#legend, #notes { visibility: hidden }")

    without = picture(phased_page(robot, tmp_path, opened))
    page = phased_page(robot, tmp_path, opened, mechanism=hinge)
    assert picture(page) != without
    assert page.locator("#mechanism").inner_text() == f"Mechanism: a hinge {EVIL}"
    assert page.locator("#phase").inner_text() == "a: not classified"
    assert "constraint 1: hinge" in page.locator("#status-key").inner_text()
    assert page.locator("img").count() == 0 and page.evaluate("window.hacked") is None


def test_hostile_names_of_recordings_with_phases(robot_of, tmp_path, opened):
    """Markup in a recording's name is text in the bands, in the phase and in the tooltips."""
    robot = robot_of("planar3")
    recording = waving(robot).trajectory(EVIL)
    page = opened(replay(robot, {EVIL: recording}, tmp_path / "a.html", phases=[(EVIL, 0.0, 2.0, 0)]).html.as_uri())
    assert page.locator("#phase").inner_text() == f"{EVIL}: constraint 1"
    titles = page.locator("#chart .bands title").all_text_contents()
    assert titles == [EVIL, f"{EVIL}: constraint 1, 0.00 s to 2.00 s"]
    assert page.locator("img").count() == 0 and page.evaluate("window.hacked") is None


def test_many_bands_fit(robot_of, tmp_path, opened):
    """Sixty recordings with phases leave every control inside the window, and the picked one has its band."""
    robot = robot_of("planar3")
    crowd = {f"recording number {i}": waving(robot, phase=0.1 * i).trajectory() for i in range(60)}
    phases = [(name, 0.5, 1.5, i % 9) for i, name in enumerate(crowd)]
    page = opened(replay(robot, crowd, tmp_path / "a.html", phases=phases).html.as_uri(), 800, 600)
    assert page.evaluate("document.documentElement.scrollHeight") <= 600
    for selector in ("#chart", "#play", "#scrub", "#speed", "#phase"):
        box = page.locator(selector).bounding_box()
        assert box["y"] + box["height"] <= 600 and box["x"] + box["width"] <= 800, selector
    page.locator("#legend .pick").nth(59).click()
    titles = page.locator("#chart .bands rect title").all_text_contents()
    assert any(title.startswith("recording number 59:") for title in titles)


def test_live_view_follows(robot_of, opened):
    """The browser shows the posture that was given last."""
    robot = robot_of("wrist")
    tip = robot.frame("tip")
    with LiveViewer(robot, open_browser=False) as viewer:
        page = opened(viewer.url)
        for angle in (0.3, -1.1):
            q = np.full(robot.nv, angle)
            viewer.show(q, manipulability=abs(angle), time=10.0 + angle)
            wait_until(page, f"Math.abs(manipLearn.time - {10.0 + angle}) < 1e-9")
            np.testing.assert_allclose(link_pose(page, robot.name, "tip"), robot.pose(q, tip), atol=POSES)
        assert page.evaluate("manipLearn.drawing")


def test_between_samples_everything_is_interpolated(robot_of, tmp_path, opened):
    """Between two samples links, readout and the dot on the curve are where interpolation in time puts them."""
    robot = robot_of("planar3")
    rollout = waving(robot, 4.0, dt=0.5)
    page = opened(replay(robot, {"a": rollout}, tmp_path / "a.html").html.as_uri())
    for t in (0.1, 0.25, 1.45, 3.9):
        page.evaluate("t => manipLearn.seek(t)", t)
        q = np.array([np.interp(t, rollout.time, column) for column in rollout.q.T])
        np.testing.assert_allclose(link_pose(page, "a", "tip"), robot.pose(q, robot.frame("tip")), atol=POSES)
        mu = float(np.interp(t, rollout.time, rollout.manipulability))
        assert float(page.locator("#legend .mu").inner_text().split()[0]) == pytest.approx(mu, rel=6e-3)
        x, y = (float(page.locator("#chart circle").get_attribute(name)) for name in ("cx", "cy"))
        points = page.locator("#chart polyline").get_attribute("points")
        line = np.array([[float(v) for v in point.split(",")] for point in points.split()])
        assert y == pytest.approx(np.interp(x, *line.T), abs=0.2)
