"""The page on which an arm is taught, in a browser, with a program that is played: what it draws, posts and says."""

from __future__ import annotations

import json
from contextlib import closing, contextmanager
from functools import partial
from itertools import count

import numpy as np
import pytest
from test_playback_browser import CONTROLS, boxes, browser_page, keeps_no_reader_out, wait_for_frames, wait_until
from test_teaching_stranger import READY

from manip_learn.playback.appearance import joint_tracks
from manip_learn.playback.live_viewer import LiveProcess
from manip_learn.playback.page_writer import to_base64
from manip_learn.teach.picture import teaching_page

pytestmark = pytest.mark.browser

START = np.array([0.3, 0.7, 0.5])
HOSTILE = "<img src=x onerror=alert(1)>"
WIDE = 1000
# answers come 0.05 s late; how many are under way, and most ever
SLOW = """() => {
  const send = window.fetch;
  window.underWay = [0, 0];
  window.fetch = async (...asked) => {
    underWay[1] = Math.max(underWay[1], ++underWay[0]);
    const [answer] = await Promise.all([send(...asked), new Promise((done) => setTimeout(done, 50))]);
    underWay[0]--;
    return answer;
  };
}"""
STATE = {
    "leader": None, "doing": "idle", "said": "Take the arm by its hand.", "wrong": False, "recordings": [],
    "recording": None, "progress": None, "answer": None, "truth": None, "can": {"run": False, "compare": False},
    "unlearnt": 0, "run": None, "files": [], "keep": "/kept/here",
}  # fmt: skip
RECORDINGS = [
    {"name": HOSTILE, "seconds": 4.2, "samples": 420, "odd": "", "phases": [[0, 2, -1], [2, 4.2, 0]], "kept": True},
    {"name": "second", "seconds": 3.0, "samples": 300, "odd": "leaves the line", "phases": [], "kept": True},
]
LINE = [to_base64(np.array([[0.4, 0.4, 0.0], [0.9, 0.4, 0.0]]), "<f4")]
ANSWER = {
    "sentence": "The hand moves along a line.", "refused": False, "evidence": "They agree to 0.4 mm.",
    "facts": [["direction", "-x within 0.3 degrees"]], "rows": [["1", "held", "310", "1e-6"]],
    "warnings": ["recordings are few"], "odd": [["second", "leaves the line"]], "next": "", "offer": None,
    "phaseKinds": [{"label": HOSTILE, "colour": "#0072b2"}],
    "mechanism": {"type": "line", "sentence": "a line", "patches": [], "way": "", "hold": False, "shown": "",
                  "lines": LINE},
}  # fmt: skip
REFUSAL = ANSWER | {
    "refused": True, "mechanism": None, "next": "Show it from the other side.",
    "offer": {"say": "Turn the arm", "said": {"do": "scene", "kind": "door"}},
}  # fmt: skip
LEARNT = {"recordings": RECORDINGS, "answer": ANSWER, "can": {"run": True, "compare": True}}
MARKS = {"free": [[1, 0, 0]], "held": [[0, 1, 0]], "turns": [], "fixed": [[0, 0, 1]]}


class Program:
    """Shows its page what it is given, and keeps what it hears."""

    def __init__(self, robot):
        self.robot, self.tip = robot, robot.frame("tip")
        self.heard, self.visits, self.state = [], count(1), STATE
        self.process = LiveProcess(lambda token: teaching_page(robot, "arm", token), 60.0, self.hear)
        self.handle = [*robot.pose(START, self.tip)[:2, 3], 0.0]
        shut = np.eye(4)
        shut[:3, 3] = self.handle
        body = [[0, -0.2, 0, 0.3, 0.3, 0.2, "body"]]
        leaf = [[0, -0.03, 0, 0.28, 0.02, 0.18, "front"], [0, 0, 0, 0.1, 0.02, 0.02, "handle"]]
        self.put("scene", {
            "number": 1, "kind": "drawer", "title": "A drawer", "task": f"open it {HOSTILE}", "notes": ["no masses"],
            "handles": [{"name": "drawer", "unit": "m", "at": self.handle, "firm": True, "move": "Pull it open"}],
            "furniture": [{"fixed": {"pose": shut.ravel().tolist(), "boxes": body}, "moving": {"boxes": leaf}}],
        })  # fmt: skip
        self.say()
        self.pose(START)

    def put(self, slot, value):
        """The newest of a slot."""
        self.process.put(lambda: json.dumps(value), slot)

    def hear(self, line):
        """What a page posts; the first that comes leads."""
        if "said" in line:
            self.heard.append(line["said"])
        elif line["pages"] and self.state["leader"] is None:
            self.say(leader=line["pages"][0])

    def say(self, **more):
        """A state that differs from the one before in this."""
        self.state = self.state | more
        self.put("state", self.state)

    def begin(self, page, said="", **more):
        """The state at first, but for this, with nothing heard yet; wait until the page has it."""
        said = said or f"Visit {next(self.visits)}."
        self.state = STATE
        self.say(leader=page.evaluate("manipLearnTeach.id"), said=said, **more)
        wait_until(page, f"document.getElementById('said').textContent === {said!r}")
        wait_for_frames(page)
        self.heard.clear()

    def pose(self, q, **more):
        """A posture, with the rest as it is when nothing happens."""
        self.q = q
        values = joint_tracks(self.robot, np.array([q]))[0].tolist()
        calm = {"time": 1.0, "held": [False], "near": None, "hand": None, "weak": None, "mu": 0.2, "marks": None,
                "limit": [], "touches": [], "opening": [0.0], "seq": self.last("pull").get("seq", 0),
                "trail": False, "furniture": [[*self.handle, 1, 0, 0, 0]]}  # fmt: skip
        self.put("pose", calm | {"values": values} | more)

    def all(self, do):
        """Everything of a kind that was heard."""
        return [said for said in self.heard if said["do"] == do]

    def last(self, do):
        """The newest of a kind, or nothing."""
        return (self.all(do) or [{}])[-1]

    def comes(self, beats):
        """Whether the pull is at the handle; until then the clock goes on."""
        self.pose(self.q, time=1.0 + 0.1 * next(beats))
        return np.allclose(self.last("pull").get("to", [np.inf] * 3), self.handle, atol=1e-6)


@contextmanager
def running(chromium, robot, before=""):
    """A program and its page, the arm drawn."""
    program, more = Program(robot), {"before": before, "ready": READY, "reduced_motion": "no-preference"}
    with closing(program.process), browser_page(chromium, program.process.url, WIDE, 640, **more) as page:
        yield program, page


@pytest.fixture(scope="module")
def desk(chromium, robot_of):
    """A program with a planar arm, and its page on a wide screen."""
    with running(chromium, robot_of("planar3")) as both:
        yield both


@pytest.fixture
def program(desk):
    """The program as it was at first; its page looks from the side and above."""
    program, page = desk
    page.keyboard.press("Escape")
    page.locator("[data-view=iso]").click()
    program.put("ghosts", None)
    program.pose(START)
    program.begin(page)
    return program


@pytest.fixture
def page(program, desk):
    """Its page."""
    return desk[1]


def until(page, true, what):
    """Wait until something is true of what the program has heard."""
    for _ in range(1000):
        if true():
            return
        page.wait_for_timeout(20)
    raise AssertionError(what)


def on_screen(page, what):
    """Where a place is [px]."""
    return np.array(list(page.evaluate(f"manipLearnTeach.{what}").values()))


def drag(page, by, keys=(), steps=8, start=None):
    """Take the tip, or what is elsewhere, press keys, move, let go of nothing yet."""
    x, y = on_screen(page, "tipOnScreen()") if start is None else start
    page.mouse.move(x, y)
    page.mouse.down()
    for key in keys:
        page.keyboard.down(key)
    page.mouse.move(x + by[0], y + by[1], steps=steps)


def let_go(program, page):
    """Release the mouse, and wait until that was heard."""
    page.mouse.up()
    until(page, lambda: program.all("release"), "no release")


def unfold(page, step):
    """Open a card."""
    page.locator(f"#step-{step}:not([inert])").evaluate("card => { card.open = true; }")


def test_dragging_the_tip_pulls_it_in_the_plane_of_the_view(program, page):
    """Links are drawn within 1e-9 of forward kinematics. A pull goes from the tip on, in the plane across the view, to
    where the pointer is; the newest comes last, one at a time, again while it is held, and then the release. While x, y
    or z is down it moves along that axis of the base alone; with shift the hand turns instead.
    """
    for link in ("link1", "tip"):
        drawn = np.array(page.evaluate("link => manipLearnTeach.linkPose(link)", link)).reshape(4, 4)
        np.testing.assert_allclose(drawn, program.robot.pose(START, program.robot.frame(link)), atol=1e-9)
    to_eye, tip = np.array(page.evaluate("manipLearnTeach.toEye()")), program.robot.pose(START, program.tip)[:3, 3]
    page.evaluate(SLOW)
    drag(page, (70, -40), steps=30)
    number = len(program.all("pull"))
    until(page, lambda: len(program.all("pull")) > number + 2, "a pull that is held is not said again")
    assert page.evaluate("underWay[1]") == 1, "two pulls were under way at a time"
    let_go(program, page)
    pulls = program.all("pull")
    np.testing.assert_allclose(pulls[0]["to"], tip, atol=1e-9)
    for pull in pulls:
        assert pull["link"] is None and pull["at"] is None and pull["turn"] is None
        assert abs(to_eye @ (np.array(pull["to"]) - tip)) < 1e-9
    seen = on_screen(page, f"screenOf({pulls[-1]['to']})")
    np.testing.assert_allclose(seen, on_screen(page, "tipOnScreen()") + [70, -40], atol=0.1)
    assert [p["seq"] for p in pulls] == sorted({p["seq"] for p in pulls}) and program.heard[-1] == {"do": "release"}
    program.pose(START)
    wait_until(page, f"manipLearnTeach.drawnSeq === {pulls[-1]['seq']}")
    for axis, key in enumerate("xyz"):
        program.heard.clear()
        drag(page, (60, -50), keys=key)
        until(page, lambda: len(program.all("pull")) > 2, "no pull")
        page.keyboard.up(key)
        let_go(program, page)
        moved = np.array(program.last("pull")["to"]) - program.all("pull")[0]["to"]
        assert abs(moved[axis]) > 0.01
        np.testing.assert_allclose(np.delete(moved, axis), 0.0, atol=1e-9)
    drag(page, (60, 0), keys=["Shift"])
    until(page, lambda: program.last("pull")["turn"], "the hand does not turn")
    page.keyboard.up("Shift")
    page.mouse.up()
    turn = np.array(program.last("pull")["turn"])
    assert np.linalg.norm(np.cross(turn, to_eye)) < 1e-9 < np.linalg.norm(turn)


def test_the_hand_is_moved_by_keys(program, page):
    """H takes the tip, arrows and page keys move the pull by a centimetre, N goes to the nearest handle, G
    grips, escape lets go.
    """
    page.locator("#scene").focus()
    page.keyboard.press("h")
    until(page, lambda: program.all("pull"), "H does not take the hand")
    for key in ("ArrowUp", "PageUp", "ArrowLeft"):
        before, number = np.array(program.last("pull")["to"]), len(program.all("pull"))
        page.keyboard.press(key)
        until(page, lambda number=number: len(program.all("pull")) > number + 1, key)
        assert np.linalg.norm(np.array(program.last("pull")["to"]) - before) == pytest.approx(0.01, abs=1e-9), key
    page.keyboard.press("n")
    until(page, partial(program.comes, count()), "N does not go to the handle")
    page.keyboard.press("g")
    until(page, lambda: program.all("grip") == [{"do": "grip", "closed": True}], "G does not grip")
    page.keyboard.press("Escape")
    until(page, lambda: program.all("release"), "escape does not let go")


def test_everything_is_text_and_keeps_no_reader_out(program, page):
    """Recordings, their oddities, the answer, the truth and files are shown as they were said, markup in them too; axe
    finds nothing that is serious or worse, light and dark; nothing is too wide.
    """
    truth = {"sentence": HOSTILE, "errors": [["angle", "0.3 degrees"]], "lines": LINE}
    files = [{"name": "a.csv", "says": "two motions <1>", "number": 1}]
    more = {"files": files, "progress": {"step": "Reading", "share": 0.4}}
    assert HOSTILE in page.locator("#headline").inner_text()
    program.say(**LEARNT, truth=truth, wrong=True, **more)
    weak = {"direction": [0, 1, 0], "share": 0.05}
    touches = [program.robot.pose(START, program.robot.frame("link1"))[:3, 3].tolist()]
    seen = {"marks": MARKS, "held": [True], "opening": [0.123], "weak": weak, "limit": ["joint2"], "touches": touches}
    program.pose(START, **seen)
    wait_until(page, "document.getElementById('scene-key').innerText.includes('hardly move this way')")
    names = page.evaluate("[...document.querySelectorAll('#recordings input')].map(box => box.value)")
    assert names == [HOSTILE, "second"]
    page.evaluate("for (const list of document.querySelectorAll('.more, .step')) list.open = true")
    for place, parts in {
        "#answer": (ANSWER["sentence"], "0.4 mm", "within 0.3 degrees", "310", "recordings are few", HOSTILE),
        "#recordings": ("odd: leaves the line",), "#files": ("two motions <1>",), "#keep": ("/kept/here",),
        "#scene-key": ("drawer: gripped · 12.3 cm open", "joint2 is at its limit", "the arm touches the furniture",
                       "free to move", "the truth", "line that was learnt"),
    }.items():  # fmt: skip
        said = page.locator(place).text_content()
        assert all(part in said for part in parts), said
    assert HOSTILE in page.locator("#truth-words").inner_text()
    assert page.locator("#holding").inner_text() == "Holding the drawer. Pull it open. To let go:"
    assert page.locator("#teach img").count() == 0
    keeps_no_reader_out(page)
    assert page.evaluate("document.documentElement.scrollWidth") <= WIDE
    for name, left, right, *_ in boxes(page, CONTROLS):
        assert left >= 0 and right <= WIDE, name
    page.emulate_media(color_scheme="light")


def test_what_the_person_does_is_posted(program, page):
    """Buttons, keys and names say what they are for, and space stops a run. Where another tab leads, a banner says so,
    nothing can be done but to take the arm, and no pull is posted.
    """
    page.keyboard.press("r")
    program.say(**LEARNT)
    program.pose(START, marks=MARKS)
    unfold(page, "show")
    page.locator("#recordings input").nth(1).fill("opened twice")
    page.keyboard.press("Enter")
    page.locator("#recordings button", has_text="Replay").nth(1).click()
    page.locator("#recordings button", has_text="Delete").nth(1).click()
    page.locator("#recordings button", has_text="Sure?").click()
    page.locator("#compare").click()
    page.locator("#run").click()
    program.say(doing="running")
    wait_until(page, "document.querySelector('#actions .next').innerText.startsWith('Stop')")
    page.locator("#scene").focus()
    page.keyboard.press(" ")
    program.say(doing="idle")
    until(page, lambda: program.all("stop"), "space does not stop it")
    for expected in (
        {"do": "record"}, {"do": "rename", "name": "second", "to": "opened twice"}, {"do": "replay", "name": "second"},
        {"do": "delete", "name": "second"}, {"do": "compare"}, {"do": "run"}, {"do": "stop"},
    ):  # fmt: skip
        assert expected in program.heard, expected
    assert not program.all("pull")
    program.say(can=STATE["can"], answer=REFUSAL)
    page.locator("#offer").click()
    until(page, lambda: program.last("scene") == {"do": "scene", "kind": "door"}, "the offer is not taken")
    assert "Show it from the other side." in page.locator("#answer").inner_text()
    program.say(leader="another")
    wait_until(page, "document.getElementById('banner').checkVisibility()")
    assert "Another tab has the arm" in page.locator("#banner").inner_text() and page.locator("#record").is_disabled()
    program.heard.clear()
    drag(page, (30, 0))
    page.mouse.up()
    page.keyboard.press("r")
    page.locator("#lead").click()
    until(page, lambda: program.heard, "not taken")
    assert program.heard == [{"do": "lead"}]


def test_files_come_in(program, page):
    """One that is dropped is posted, if it is a CSV that is not too long."""
    drop = """([name, size]) => {
        const data = new DataTransfer();
        data.items.add(new File(["x".repeat(size)], name));
        const about = { dataTransfer: data, bubbles: true, cancelable: true };
        for (const kind of ["dragover", "drop"]) document.dispatchEvent(new DragEvent(kind, about));
    }"""  # fmt: skip
    for name, size, words in (("a.txt", 3, "no CSV"), ("long.csv", 11 * 1024 * 1024, "at most 10 MB")):
        page.evaluate(drop, [name, size])
        wait_until(page, f"document.getElementById('said').innerText.includes('{words}')")
    page.evaluate(drop, ["a.csv", 3])
    until(page, lambda: program.last("drop") == {"do": "drop", "name": "a.csv", "text": "xxx"}, "not dropped")
    assert len(program.all("drop")) == 1


def test_the_next_step_and_the_cards(program, page):
    """One button is large: record, stop, learn, let the arm do it, reset; the card at hand is open, the others are a
    line, and the answer stands above the arm. A key that the page knows works whatever has the focus.
    """
    five = [RECORDINGS[1] | {"name": f"motion {k}"} for k in range(5)]
    done = {"done": 0.2, "wanted": 0.2, "unit": "m", "ended": "all of it is done", "ordered": True, "notes": [HOSTILE]}
    shown = {"recordings": five, "unlearnt": 5}
    learnt = {**LEARNT, "recordings": five, "answer": ANSWER | {"line": "It slides."}}
    for state, button, step in (
        ({}, "Record 1 of 5", "show"),
        ({"doing": "recording", "recording": {"name": "recording", "seconds": 1.2}}, "Stop (1.2 s)", "show"),
        (shown, "Learn", "show"),
        ({"recordings": five, "answer": REFUSAL}, "Record another one", "learn"),
        (learnt, "Let the arm do it", "do"),
        ({**learnt, "doing": "running"}, "Stop", "do"),
        ({**learnt, "run": done}, "Reset the arm", "do"),
    ):
        program.begin(page, button, **state)
        assert page.locator("#actions .next").inner_text().split("\n")[0].strip() == button
        assert page.evaluate("[...document.querySelectorAll('.step[open]')].map(s => s.id)") == [f"step-{step}"]
    assert page.locator("#headline").inner_text() == "It slides."
    assert "20.0 cm of 20.0 cm" in page.locator("#step-do summary").inner_text()
    assert page.locator("#run-notes").inner_text() == HOSTILE
    page.locator("#home").focus()
    page.keyboard.press("r")
    until(page, lambda: program.all("record"), "R does nothing while a button has the focus")


@pytest.mark.parametrize("end", ["ended", "lost"])
def test_an_end_and_a_lost_line_are_told(chromium, robot_of, end):
    """A drag that turns the view before the first pull is explained. When the program is gone the page says so, and
    everything is disabled.
    """
    with running(chromium, robot_of("planar3"), before="window.errors = 1") as (program, page):
        scene = page.locator("#scene").bounding_box()
        drag(page, (200, 0), start=(scene["x"] + 20, scene["y"] + 40))
        page.mouse.up()
        wait_until(page, "document.getElementById('hand-hint').checkVisibility()")
        assert "That turned the view" in page.locator("#hand-hint").inner_text()
        program.put("ended", True) if end == "ended" else program.process.close()
        words = {"ended": "The program has ended", "lost": "connection to the program is lost"}[end]
        wait_until(page, f"document.getElementById('banner').innerText.includes({words!r})")
        assert page.locator("#record").is_disabled() and not page.evaluate("manipLearnTeach.allowed")


def test_ghosts_are_played_beside_the_arm(program, page):
    """Each has a button that hides it, its curve, and says how it ended; at the end they stay, the one that failed with
    its centimetres in the picture.
    """
    times = np.linspace(0.0, 1.0, 5)
    ways = joint_tracks(program.robot, START + times[:, None] * [0.3, 0.0, 0.1])
    numbers = {"keyTimes": times, "tracks": ways, "curveTimes": times, "curve": 0.1 + times}
    ghost = {"duration": 1.0, "colour": "#0072b2"} | {name: to_base64(x, "<f8") for name, x in numbers.items()}
    said = {HOSTILE: "20.0 of 20.0 cm", "without": "9.3 of 20.0 cm"}
    ghosts = [ghost | {"name": name, "ended": ended, "colourName": "blue"} for name, ended in said.items()]
    program.say(**LEARNT)
    program.put("ghosts", {"number": 1, "kind": "compare", "rollouts": ghosts})
    wait_until(page, "document.getElementById('scene-key').innerText.includes('without: 9.3 of 20.0 cm')")
    assert page.locator("#ghost-ends button").first.inner_text() == HOSTILE and page.locator(".curve").count() == 2
    page.locator("#ghost-ends button").last.click()
    wait_until(page, "!document.getElementById('scene-key').innerText.includes('without: 9.3')")
    page.locator("#no-ghosts").click()
    until(page, lambda: program.last("ghosts") == {"do": "ghosts", "show": False}, "not removed")
