"""The command line: results, one JSON document, and one sentence with exit code 2 for any invalid input."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
import unicodedata
from pathlib import Path

import numpy as np
import pytest
from case import rows_in
from recording_corpus import HEADER
from recording_formats import table
from test_playback import data_in

from manip_learn.cli import main
from manip_learn.commands.command_line import WRITTEN
from manip_learn.commands.output import SENTENCES
from manip_learn.commands.program import program
from manip_learn.control.rollout import Rollout

DATA = Path(__file__).resolve().parents[1] / "examples" / "data"
ROBOTS = DATA.parents[1] / "robots"
DRAWER = sorted(map(str, (DATA / "sawyer_drawer").glob("*.csv")))[:6]
FRAME = ("--frame", "right_gripper_tip")


@pytest.fixture(scope="module")
def learnt(tmp_path_factory):
    """The constraint file of the shipped drawer."""
    constraint = tmp_path_factory.mktemp("learnt") / "drawer.json"
    assert main(["learn", "sawyer", *DRAWER, *FRAME, "--out", str(constraint), "--json"]) == 0
    return constraint


def run_program(*words, **options):
    """Run a program until it ends."""
    return subprocess.run(words, capture_output=True, text=True, timeout=100, **options)


def test_a_chosen_frame_is_named(answer):
    """`learn` without `--frame` says which frame it took; with it there is nothing to say."""
    for options, named in (((), True), (FRAME, False)):
        notes = " ".join(answer("learn", "sawyer", *DRAWER, *options)["notes"])
        assert ("guided frame is right_gripper_tip" in notes) is named


def test_learn_answers_with_one_json_document(answer):
    """All keys of the contract are there, the drawer's two held rows are found, and nothing else is printed."""
    result = answer("learn", "sawyer", *DRAWER, *FRAME)
    keys = "selection axes free_directions gap held_out_residual uncertainty_deg warnings"
    assert {*keys.split()} <= set(result)
    assert (result["n_constraints"], result["reference"], result["estimator"]) == (2, "world", "null-space")
    (free,) = result["free_directions"]
    truth = [np.cos(np.radians(25)), np.sin(np.radians(25)), 0.0]
    assert np.degrees(np.arccos(min(1.0, abs(np.dot(free, truth))))) < 0.1


def test_the_next_line_does_the_task_when_it_is_pasted(run):
    """Robot, file and options as they were given, quoted for a shell; without --out the line says where it goes."""
    arm = Path("my arm") / "the sawyer.urdf.xacro"
    arm.parent.mkdir()
    described = (ROBOTS / "sawyer.urdf").read_text(encoding="utf-8")
    colour = '<material name="$(arg called)"><color rgba="1 1 1 1"/></material>'
    named = '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="sawyer"><xacro:arg name="called" default="pink"/>'
    arm.write_text(described.replace('<robot name="sawyer">', named + colour), encoding="utf-8")
    given = ("--package-dir", "my arm", "--xacro-arg", "called=light pink")
    code, out, err = run("learn", arm, *DRAWER, *FRAME, *given)
    assert (code, err) == (0, "")
    for words in ("written: ", "1 motion completed as demonstrated"):
        (line,) = (line for line in out.splitlines() if line.startswith("next: manip-learn "))
        code, out, err = run(*shlex.split(line)[2:])
        assert (code, err) == (0, "") and words in out, line
    assert Path("run.html").exists()


def test_a_weak_task_has_the_time_that_it_takes(answer, learnt):
    """To come within half the tolerance: e^(-gain t) of the way is left; the keys of the contract are there."""
    control = ("control", "sawyer", learnt, "--start", "0 -1 0 1.5 0 1 0", "--target", "0.6,0.27,0.35")
    slow = answer(*control, "--task-gain", "0.5", "--out", "slow.npz")
    error = Rollout.load("slow.npz").task_error[0]
    assert slow["duration"] == pytest.approx(np.log(2.0 * error / 0.01) / 0.5, abs=0.01)
    assert slow["reached"] is True and slow["final_error"] < 0.01
    assert 0.0 < slow["min_manipulability"] <= slow["mean_manipulability"] and slow["max_velocity"] > 0.0
    assert sum(slow["status_counts"].values()) == round(slow["duration"] / 0.01) + 1


def test_replay_shows_what_was_learnt(run, answer, learnt):
    """With the constraint file, the page has the phases and the mechanism that were saved with the constraint."""
    content = json.loads(learnt.read_text(encoding="utf-8"))
    name = Path(DRAWER[0]).name
    phases = [[name, 0.2, 1.0, None], [name, 1.0, 2.5, 0], ["not shown", 0.0, 1.0, 0]]
    content["provenance"] |= {"phases": phases}
    Path("held.json").write_text(json.dumps(content), encoding="utf-8")
    answer("replay", "sawyer", DRAWER[0], "--constraint", "held.json", "--html", "a.html")
    data = data_in(Path("a.html"))
    assert data["rollouts"][0]["phases"] == [[0.2, 1.0, -1], [1.0, 2.5, 0]]
    assert [k["label"] for k in data["phaseKinds"]] == ["constraint 1: line", "free motion"]
    assert data["mechanisms"][0]["sentence"] == content["provenance"]["mechanism"]["sentence"]
    code, _, err = run("replay", "sawyer", DRAWER[1], "--constraint", "held.json", "--html", "b.html")
    assert code == 2 and name in err


def test_unrecorded_fingers_are_locked(answer):
    """Recordings of a Panda without its fingers suffice, `control` finds the same seven joints; `--html` plays all."""
    written = ("--out", "c.json", "--html", "a.html")
    result = answer("learn", "panda", DATA / "panda_drawer_whole", "--frame", "panda_hand_tcp", *written)
    assert any("panda_finger_joint1" in note and "locked" in note for note in result["notes"])
    assert len(data_in(Path("a.html"))["rollouts"]) == 6 and result["html"] == str(Path("a.html").resolve())
    answer("control", "panda", "c.json", "--duration", "0.1")


def test_robots_are_listed_and_looked_at(run, answer, monkeypatch):
    """`robots` lists the names and their joints; `inspect` prints the likely tip with its flag, and the next command,
    within 80 columns; `--version` prints the version.
    """
    monkeypatch.setenv("COLUMNS", "80")
    robots = {r["name"]: r["joints"] for r in answer("robots")["robots"]}
    assert robots["planar3"] == ["joint1", "joint2", "joint3"]
    code, out, err = run("robots")
    assert code == 0 and "sawyer (7)" in " ".join(out.split()) and "manip_learn[descriptions]" in out
    summary, (code, out, _), tip = answer("inspect", "sawyer"), run("inspect", "sawyer"), FRAME[1]
    lines = out.splitlines()
    assert code == 0 and all(len(line) <= 80 for line in lines if not line.startswith("file: "))
    assert tip in summary["frames"] and f"likely tips {tip} (--frame {tip})" in " ".join(out.split())
    assert lines[-1] == f"next: manip-learn learn sawyer RECORDINGS --frame {tip}"
    assert (summary["name"], summary["nq"], summary["nv"], summary["warnings"]) == ("sawyer", 7, 7, [])
    code, out, err = run("--version")
    assert (code, err) == (0, "") and out.startswith("manip-learn ")


@pytest.mark.parametrize(
    ("failure", "code", "said"),
    [
        (ZeroDivisionError("oh"), 1, "internal error (ZeroDivisionError: oh); please report it"),
        (MemoryError(), 2, "not enough memory"),
        (OSError(5, "Input/output error", "a.csv"), 2, "the system refuses: Input/output error (a.csv)"),
        (KeyboardInterrupt(), 130, ""),
    ],
)
def test_our_own_failure_is_no_traceback(failure, code, said, run, monkeypatch):
    """What no command expects gives its exit code and one sentence; so does a line without a command."""

    def broken(*_arguments, **_options):
        raise failure

    monkeypatch.setattr("manip_learn.commands.robots.inspect_robot", broken)
    got, out, err = run("inspect", "sawyer")
    assert (got, out, err.count("\n")) == (code, "", bool(said)) and said in err
    assert run()[0] == 2 and "no command given" in run()[2]


def test_a_refusal_to_learn_holds_its_evidence(run):
    """The gaps and the advice are there for a program: free motion shows no constraint."""
    rng = np.random.default_rng(0)
    for i in range(3):
        q = np.cumsum(rng.normal(0, 0.004, (200, 3)), axis=0) + [0.3, 0.6, 0.9]
        table(HEADER, np.arange(200) * 0.01, q, name=f"free_{i}.csv")(Path())
    code, out, err = run("learn", "planar3", ".", "--axes", "x y", "--json")
    error = json.loads(out)["error"]
    assert code == 2 and error["code"] in ("weak-gap", "no-evidence")
    assert set(error["gaps"]) == {"1", "2"} and all(gap > 0 for gap in error["gaps"].values())
    assert error["advice"] and all(text in error["message"] for text in error["advice"])


def test_a_reader_that_leaves_is_no_error():
    """`| head -1`: nothing on standard error but what the command has to say, and no failure of its own."""
    for words in ("inspect sawyer", "learn --help", "learn --json"):
        command = [sys.executable, "-u", "-m", "manip_learn", *words.split()]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as done:
            assert done.stdout is not None and done.stderr is not None
            done.stdout.readline()
            done.stdout.close()
            said, usage = done.stderr.read(), words == "learn --json"
            assert done.wait(60) == (2 if usage else 0), words
        assert "Traceback" not in said and "Broken" not in said and (usage or said == ""), words


INPUTS = {"robot": "arm.urdf", "driver": "driver.py", "constraint": "held.json", "task": "held.json"} | dict.fromkeys(
    ("recordings", "rollouts", "files"), "rec_01.csv"
)
REPLACING = [
    (name, parameter.opts[0], read)
    for name, command in sorted(program.commands.items())
    for parameter in command.params
    if parameter.name in WRITTEN
    for read in [p.name for p in command.params if p.name in INPUTS]
    if name != "demo"  # which names its robot, and reads no file of a user's
]


@pytest.mark.parametrize(("name", "flag", "read"), REPLACING)
def test_no_output_replaces_an_input(run, tmp_path, name, flag, read):
    """Every command refuses to write over what it reads, by any spelling, link or hard link, and touches nothing."""
    (tmp_path / "folder").mkdir()
    for file in {*INPUTS.values(), "folder/rec_02.csv", "folder/base.stl"}:
        Path(file).write_text(f"time,j1\n0.0,{len(file)}\n")
    Path("arm.urdf").write_text('<robot><mesh filename="package://arm/folder/base.stl"/></robot>')
    line, source = [name], INPUTS[read]
    for parameter in program.commands[name].params:
        if parameter.name in INPUTS:
            spec = INPUTS[parameter.name] + (":Arm" if parameter.name == "driver" else "")
            line += [spec] if parameter.param_type_name == "argument" else [parameter.opts[0], spec]
    Path("link").symlink_to(source)
    Path("hard").hardlink_to(source)
    outputs = [source, f"folder/../{source}", str(tmp_path / source), "link", "hard"]
    outputs += {"rec_01.csv": ["folder/rec_02.csv"], "arm.urdf": ["folder/base.stl"]}.get(source, [])
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    for out in outputs:
        words = ["folder" if word == source and out == "folder/rec_02.csv" else word for word in line]
        code, said, err = run(*words, flag, out)
        assert (code, said, err.count("\n")) == (2, "", 1) and "would replace an input" in err, (words, out, err)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


EXAMPLES = {name: command.callback.example.split()[1:] for name, command in program.commands.items()}
# in an order in which each finds what it reads; the last ones end when somebody does something
IN_ORDER = "robots inspect demo learn audit control repeat replay export reproduce record teach".split()


@pytest.mark.timeout(300)
def test_every_help_begins_with_an_example_that_works(run, monkeypatch):
    """One after the other in an empty folder; the page, the arm and the experiments, which take long, are stand-ins;
    nobody comes to the page of `teach`.
    """
    monkeypatch.setattr("manip_learn.teach.session.TeachingSession.run", lambda _session: None)
    monkeypatch.setattr("webbrowser.open", lambda _address: True)
    monkeypatch.setattr("manip_learn.commands.reproduce.run_experiments", lambda *_given, **_more: {})
    Path("my_arm.py").write_text(
        "class Driver:\n"
        "    period, joint_names, time = 0.01, ('shoulder_pan_joint',), 0.0\n"
        "    def read(self): return [0.0], None, None\n"
        "driver = Driver()\n"
    )
    assert set(IN_ORDER) == set(EXAMPLES) and run("--help")[1].startswith("Example: manip-learn demo")
    for name in IN_ORDER:
        code, out, err = run(name, "--help")
        assert (code, err) == (0, "") and out.startswith(f"Example: manip-learn {name}"), name
        if name == "demo":  # has a test of its own
            continue
        code, _, err = run(*EXAMPLES[name], *(["--duration", "0.1", "--no-browser"] if name == "record" else []))
        assert code == 0, (name, err)


def test_exported_files_are_named_after_their_recordings(run, answer):
    """Numbered as they are read, with as many digits as the last one has; signs that a shell minds become a line; none
    replaces a recording.
    """
    names = [f"my demo ({k}) of {'x' * 90}.csv" for k in range(10, 21)] + ["last.1.csv"]
    for name in names:
        shutil.copy(DATA / "planar3_reach" / "demo_01.csv", name)
    result = answer("export", "planar3", *names, "--to", "csv", "--out", "many")
    expected = [f"{k:02d}_{f'my_demo_{k + 10}_of_' + 'x' * 90:.80}.csv" for k in range(11)] + ["11_last.1.csv"]
    assert [Path(f).name for f in result["files"]] == sorted(p.name for p in Path("many").iterdir()) == expected
    assert run("export", "planar3", "last.1.csv", "--out", "one.CSV")[0] == 0 and Path("one.CSV").is_file()
    code, _, err = run("export", "planar3", "many/11_last.1.csv", "--to", "csv", "--out", "many")
    assert code == 2 and "many" in err


EVIL = "\x1b[31m\x9b2J\u202e"


def test_no_name_controls_the_terminal(run, tmp_path):
    """Names of files, headers, robots, joints and frames with escapes, C1 controls and marks of direction come out as
    text: in sentences, tables and notes, for people and in JSON, whatever the command has to say.
    """
    planar3 = (ROBOTS / "planar3.urdf").read_text(encoding="utf-8")
    Path(f"arm{EVIL}.urdf").write_text(planar3, encoding="utf-8")
    Path("evil.urdf").write_text(planar3.replace('"link2"', '"link2\x9b31m\u202e"'), encoding="utf-8")
    (shown := Path(f"shown{EVIL}")).mkdir()
    for k, file in enumerate(sorted((DATA / "planar3_reach").glob("*.csv"))[:6]):
        header, rows = file.read_text(encoding="utf-8").split("\n", 1)
        content = f"{header},force{EVIL}\n" + rows.replace("\n", ",0\n")
        (shown / f"{k}{EVIL}\n.csv").write_text(content, encoding="utf-8")
    Path(f"odd{EVIL}.csv").write_text(f"time,joint1,joint2{EVIL},joint3\n0,0,0,0\n", encoding="utf-8")
    for expected, command in rows_in("commands_with_names.txt"):
        words = command.format(evil=EVIL).split()
        for more in ((), ("--json",)):
            code, out, err = run(*words, *more)
            assert code == int(expected), (words, err)
            for text in (out, err, *(sentences(json.loads(out)) if more else ())):
                controls = [c for c in text if c != "\n" and unicodedata.category(c) in ("Cc", "Cf")]
                assert not controls, (words, text)
            assert len(err.splitlines()) == (code == 2), (words, err)


def sentences(content, key=""):
    """What JSON has to say to people."""
    if isinstance(content, dict):
        return [text for k, value in content.items() for text in sentences(value, k)]
    if isinstance(content, list):
        return [text for value in content for text in sentences(value, key)]
    return [content] if isinstance(content, str) and key in SENTENCES else []


@pytest.mark.parametrize("shell", ["bash", "fish"])
def test_a_shell_is_offered_names_and_flags(shell, tmp_path):
    """A robot by its first letters, a flag of the command."""
    for line, expected in (("inspect saw", "sawyer"), ("learn sawyer --col", "--columns")):
        line, environment = f"manip-learn {line}", dict(os.environ, _MANIP_LEARN_COMPLETE=f"complete_{shell}")
        environment |= {"PYTHONPATH": os.pathsep.join(sys.path), "COMP_WORDS": line, "COMP_CWORD": str(line.count(" "))}
        environment |= {"_TYPER_COMPLETE_ARGS": line, "_TYPER_COMPLETE_FISH_ACTION": "get-args"}
        done = run_program(sys.executable, "-m", "manip_learn", env=environment, cwd=tmp_path)
        assert done.stderr == "" and expected in done.stdout.split()


INTERRUPTED_AT = """
import os, re, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job would ignore it
left, sys.argv = int(sys.argv[1]), ["manip-learn", *sys.argv[2:]]

def interrupt(event, arguments):
    global left
    left -= event == "import" and signal.getsignal(signal.SIGINT) is not signal.default_int_handler
    if left == 0:
        left = -1
        os.kill(os.getpid(), signal.SIGINT)

sys.addaudithook(interrupt)
from manip_learn.cli import main
sys.exit(main())
"""


def test_ctrl_c_leaves_no_traceback_from_the_first_moment_on():
    """At whichever import `main` is when it is interrupted: exit code 130, and at most one word."""
    for moment in (1, 20, 120, 300):
        done = run_program(sys.executable, "-c", INTERRUPTED_AT, str(moment), "inspect", "planar3")
        assert done.returncode == 130 and done.stderr.strip() in ("", "interrupted"), (moment, done.stderr)


@pytest.mark.parametrize("closed", ["2>&-", ">&-", ">&- 2>&-", "<&- >&- 2>&-"])
def test_closed_streams_are_as_no_terminal(closed: str, tmp_path: Path) -> None:
    """The work is done and its files are whole, none of them in a stream's place; an error still has its exit code."""
    line = f'"$0" -m manip_learn export planar3 "{DATA / "planar3_reach"}" --to csv --out out {closed}'
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    said = {}
    for words in (line, line.replace("planar3_reach", "nothing")):
        done = run_program("sh", "-c", words, sys.executable, cwd=tmp_path, env=environment)
        said[done.returncode] = done.stdout + done.stderr
    assert said.keys() == {0, 2} and "Error" not in said[0] + said[2]
    assert len(list((tmp_path / "out").iterdir())) == 20
