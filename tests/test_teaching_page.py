"""The page on which an arm is taught, in a browser, with a program that is played: what it draws, posts and says."""

from __future__ import annotations

import json
from contextlib import closing

import numpy as np
import pytest
from test_playback_browser import browser_page, wait_until
from test_teaching_stranger import READY

from manip_learn.playback.appearance import joint_tracks
from manip_learn.playback.live_viewer import LiveProcess
from manip_learn.playback.page_writer import packed
from manip_learn.teach.picture import teaching_page

pytestmark = pytest.mark.browser

START = np.array([0.3, 0.7, 0.5])
HOSTILE = "<img src=x onerror=alert(1)>"
WIDE = 1000
# answers come 0.05 s late; how many are under way, and most ever
STATE = {
    "leader": None, "doing": "idle", "said": "Take the arm by its hand.", "wrong": False, "recordings": [],
    "recording": None, "progress": None, "answer": None, "truth": None, "can": {"run": False, "compare": False},
    "unlearnt": 0, "run": None, "files": [], "keep": "/kept/here",
}  # fmt: skip
LEARNT = {
    "recordings": [
        {"name": name, "seconds": 4.2, "samples": 420, "odd": odd, "phases": [[0, 2, -1], [2, 4.2, 0]], "kept": True}
        for name, odd in ((HOSTILE, ""), ("second", "leaves the line"))
    ],
    "answer": {
        "sentence": "The hand moves along a line.", "refused": False, "evidence": "They agree to 0.4 mm.",
        "facts": [["direction", "-x within 0.3 degrees"]], "rows": [["1", "held", "310", "1e-6"]],
        "warnings": ["recordings are few"], "odd": [["second", "leaves the line"]], "mechanism": None,
        "next": "", "offer": None, "phaseKinds": [{"label": HOSTILE, "colour": "#0072b2"}],
    },
    "can": {"run": True, "compare": True},
}  # fmt: skip


class Program:
    """Shows its page what it is given, and keeps what it hears."""

    def __init__(self, robot):
        self.robot, self.tip = robot, robot.frame("tip")
        self.heard, self.state = [], STATE
        self.process = LiveProcess(lambda token: teaching_page(robot, "arm", token), 60.0, self.hear)
        self.handle = [*robot.pose(START, self.tip)[:2, 3], 0.0]
        shut = np.eye(4)
        shut[:3, 3] = self.handle
        body, leaf = (
            [[0, y, 0, 0.3, depth, 0.2, name]] for y, depth, name in ((-0.2, 0.3, "body"), (0, 0.02, "front"))
        )
        self.put("scene", {
            "number": 1, "kind": "drawer", "title": "A drawer", "task": f"open it {HOSTILE}", "notes": ["no masses"],
            "handles": [{"name": "drawer", "unit": "m", "at": self.handle, "firm": True, "move": "Pull it open"}],
            "furniture": [{"fixed": {"pose": shut.ravel().tolist(), "boxes": body}, "moving": {"boxes": leaf}}],
        })  # fmt: skip
        self.say()
        self.pose()

    def put(self, slot, value):
        """Send the latest value of a slot."""
        self.process.put(lambda: json.dumps(value), slot)

    def hear(self, line):
        """Keep what a page posts; the first page leads."""
        if "said" in line:
            self.heard.append(line["said"])
        elif line["pages"] and self.state["leader"] is None:
            self.say(leader=line["pages"][0])

    def say(self, **changes):
        """Send a state that differs from the one before."""
        self.state = self.state | changes
        self.put("state", self.state)

    def pose(self, **changes):
        """Send the arm at START, where nothing happens but the changes."""
        values = joint_tracks(self.robot, START[None])[0].tolist()
        calm = {"time": 1.0, "held": [False], "near": None, "hand": None, "weak": None, "mu": 0.2, "marks": None,
                "limit": [], "touches": [], "opening": [0.0], "seq": self.last("pull").get("seq", 0),
                "trail": False, "furniture": [[*self.handle, 1, 0, 0, 0]]}  # fmt: skip
        self.put("pose", calm | {"values": values} | changes)

    def all(self, do):
        """Everything of a kind that was heard."""
        return [said for said in self.heard if said["do"] == do]

    def last(self, do):
        """The latest of a kind, or nothing."""
        return (self.all(do) or [{}])[-1]


@pytest.fixture
def desk(chromium, robot_of):
    """A program with a planar arm, and its page, which may lose its connection."""
    program, more = Program(robot_of("planar3")), {"before": "window.errors = 1", "ready": READY}
    with closing(program.process), browser_page(chromium, program.process.url, WIDE, 640, **more) as page:
        yield program, page


def until(page, condition, what):
    """Wait until a condition on what the program has heard holds."""
    for _ in range(1000):
        if condition():
            return
        page.wait_for_timeout(20)
    raise AssertionError(what)


def on_screen(page, what):
    """Where a point is on the screen [px]."""
    return np.array(list(page.evaluate(f"manipLearnTeach.{what}").values()))


def drag(program, page, by, key=None):
    """Drag the tip while a key is down, and return the pulls that were heard."""
    program.heard.clear()
    page.mouse.move(*on_screen(page, "tipOnScreen()"))
    page.mouse.down()
    if key is not None:
        page.keyboard.down(key)
    page.mouse.move(*on_screen(page, "tipOnScreen()") + by, steps=8)
    until(page, lambda: len(program.all("pull")) > 2, "no pull")
    page.mouse.up()
    until(page, lambda: program.all("release"), "no release")
    if key is not None:
        page.keyboard.up(key)
    return program.all("pull")


def test_dragging_the_tip_pulls_it_in_the_plane_of_the_view(desk):
    """Links are drawn within 1e-9 of forward kinematics. A pull goes from the tip, in the plane across the view, to the
    pointer, and ends with a release. With x, y or z down it moves along that axis of the base alone; with shift the
    hand turns instead.
    """
    program, page = desk
    for link in ("link1", "tip"):
        drawn = np.array(page.evaluate("link => manipLearnTeach.linkPose(link)", link)).reshape(4, 4)
        np.testing.assert_allclose(drawn, program.robot.pose(START, program.robot.frame(link)), atol=1e-9)
    to_eye, tip = np.array(page.evaluate("manipLearnTeach.toEye()")), program.robot.pose(START, program.tip)[:3, 3]
    pulls = drag(program, page, (70, -40))
    np.testing.assert_allclose(pulls[0]["to"], tip, atol=1e-9)
    for pull in pulls:
        assert pull["link"] is None and pull["at"] is None and pull["turn"] is None
        assert abs(to_eye @ (np.array(pull["to"]) - tip)) < 1e-9
    seen = on_screen(page, f"screenOf({pulls[-1]['to']})")
    np.testing.assert_allclose(seen, on_screen(page, "tipOnScreen()") + [70, -40], atol=0.1)
    assert [p["seq"] for p in pulls] == sorted({p["seq"] for p in pulls}) and program.heard[-1] == {"do": "release"}
    for axis, key in enumerate("xyz"):
        pulls = drag(program, page, (60, -50), key)
        moved = np.array(pulls[-1]["to"]) - pulls[0]["to"]
        assert abs(moved[axis]) > 0.01
        np.testing.assert_allclose(np.delete(moved, axis), 0.0, atol=1e-9)
    turn = np.array(drag(program, page, (60, 0), "Shift")[-1]["turn"])
    assert np.linalg.norm(np.cross(turn, to_eye)) < 1e-9 < np.linalg.norm(turn)


def test_the_answer_and_statuses_are_shown_as_text(desk):
    """Recordings, the answer, its warnings, the truth, statuses of the arm and files are shown; markup stays text."""
    program, page = desk
    truth = {"sentence": HOSTILE, "errors": [["angle", "0.3 degrees"]], "lines": []}
    program.say(**LEARNT, truth=truth, files=[{"name": "a.csv", "says": "two motions <1>", "number": 1}])
    weak = {"direction": [0, 1, 0], "share": 0.05}
    program.pose(held=[True], opening=[0.123], weak=weak, limit=["joint2"], touches=[[0.1, 0.0, 0.0]])
    wait_until(page, "document.getElementById('scene-key').innerText.includes('hardly move this way')")
    names = page.evaluate("[...document.querySelectorAll('#recordings input')].map(box => box.value)")
    assert names == [HOSTILE, "second"]
    for place, parts in {
        "#answer": ("moves along a line", "0.4 mm", "within 0.3 degrees", "310", "recordings are few", HOSTILE),
        "#recordings": ("odd: leaves the line",), "#files": ("two motions <1>",), "#keep": ("/kept/here",),
        "#scene-key": ("drawer: gripped · 12.3 cm open", "joint2 is at its limit", "the arm touches the furniture"),
        "#truth-words": (HOSTILE,),
    }.items():  # fmt: skip
        text = page.locator(place).text_content()
        assert all(part in text for part in parts), text
    assert page.locator("#teach img").count() == 0


def test_buttons_and_files_are_posted(desk):
    """Buttons, keys, names and dropped CSV files are posted. While another tab leads, a banner says so, and the only
    thing that can be done is to take the arm.
    """
    program, page = desk
    page.keyboard.press("r")
    program.say(**LEARNT)
    page.locator("#step-show:not([inert])").evaluate("card => { card.open = true; }")
    page.locator("#recordings input").nth(1).fill("opened twice")
    page.keyboard.press("Enter")
    page.locator("#recordings button", has_text="Replay").nth(1).click()
    page.locator("#recordings button", has_text="Delete").nth(1).click()
    page.locator("#recordings button", has_text="Sure?").click()
    page.locator("#compare").click()
    page.evaluate("""() => {
        const data = new DataTransfer();
        data.items.add(new File(["xxx"], "a.csv"));
        document.dispatchEvent(new DragEvent("drop", { dataTransfer: data, bubbles: true, cancelable: true }));
    }""")
    for expected in (
        {"do": "record"}, {"do": "rename", "name": "second", "to": "opened twice"}, {"do": "replay", "name": "second"},
        {"do": "delete", "name": "second"}, {"do": "compare"}, {"do": "drop", "name": "a.csv", "text": "xxx"},
    ):  # fmt: skip
        until(page, lambda expected=expected: expected in program.heard, expected)
    program.say(leader="another")
    wait_until(page, "document.getElementById('banner').checkVisibility()")
    assert "Another tab has the arm" in page.locator("#banner").inner_text() and page.locator("#record").is_disabled()
    program.heard.clear()
    page.mouse.move(*on_screen(page, "tipOnScreen()"))
    page.mouse.down()
    page.mouse.move(500, 300)
    page.mouse.up()
    page.keyboard.press("r")
    page.locator("#lead").click()
    until(page, lambda: program.heard, "not taken")
    assert program.heard == [{"do": "lead"}]


@pytest.mark.parametrize("end", ["ended", "lost"])
def test_the_page_says_when_the_program_has_ended(desk, end):
    """When the program has ended or the connection is lost, the page says so and disables everything."""
    program, page = desk
    if end == "ended":
        program.put("ended", True)
    else:
        program.process.close()
    words = {"ended": "The program has ended", "lost": "connection to the program is lost"}[end]
    wait_until(page, f"document.getElementById('banner').innerText.includes({words!r})")
    assert page.locator("#record").is_disabled() and not page.evaluate("manipLearnTeach.allowed")


def test_both_rollouts_of_a_comparison_are_played(desk):
    """Each rollout has its name, its curve and its end, which stays in the picture until it is hidden."""
    program, page = desk
    times = np.linspace(0.0, 1.0, 5)
    tracks = joint_tracks(program.robot, START + times[:, None] * [0.3, 0.0, 0.1])
    numbers = {"keyTimes": times, "tracks": tracks, "curveTimes": times, "curve": 0.1 + times}
    ghost = {"duration": 1.0, "colour": "#0072b2"} | {name: packed(x, "<f8") for name, x in numbers.items()}
    ends = {HOSTILE: "20.0 of 20.0 cm", "without": "9.3 of 20.0 cm"}
    ghosts = [ghost | {"name": name, "ended": ended, "colourName": "blue"} for name, ended in ends.items()]
    program.say(**LEARNT)
    program.put("ghosts", {"number": 1, "kind": "compare", "rollouts": ghosts})
    wait_until(page, "document.getElementById('scene-key').innerText.includes('without: 9.3 of 20.0 cm')")
    assert page.locator("#ghost-ends button").first.inner_text() == HOSTILE and page.locator(".curve").count() == 2
    page.locator("#ghost-ends button").last.click()
    wait_until(page, "!document.getElementById('scene-key').innerText.includes('without: 9.3')")
