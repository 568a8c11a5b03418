"""Reading on a dask cluster: a real scheduler, real worker processes, and one of them killed."""

from __future__ import annotations

import gc
import json
import os
import signal
import sys
import threading

import numpy as np
import pytest
from scale_motions import TWO, motions

import manip_learn as ml
from manip_learn.cli import main
from manip_learn.errors import ManipLearnError, MissingExtraError, RecordingError
from manip_learn.learning.table import dask_client, map_parts
from manip_learn.recordings import load as trajectory_source

pytest.importorskip("distributed", reason="the extra 'dask' is not installed")
import dask

HELD = {"n_constraints": 2, "estimator": "null-space", "most_samples": 3000}
# the cluster's own clean-up of sockets and processes is not ours to judge
pytestmark = [pytest.mark.filterwarnings("ignore::ResourceWarning"), pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def client():
    """Two worker processes on this machine."""
    with dask_client("local", 2) as client:
        yield client


@pytest.fixture
def source(features, tmp_path, monkeypatch):
    """Forty files without velocities, more samples than are learnt from, in many parts."""
    for i, t in enumerate(motions(features, TWO, np.random.default_rng(5), 40, noise=0.02, held=True)):
        np.savez(tmp_path / f"demo_{i:03d}.npz", time=t.time, q=t.q, joint_names=np.array(t.joint_names))
    monkeypatch.setattr(trajectory_source, "PART_BYTES", 12_000)
    source = ml.RecordingSource(tmp_path, features.robot)
    assert source.n_parts > 10
    return source


def test_workers_change_nothing(client, features, source):
    """Two workers, one of which is killed in the middle and replaced, give the answer of this process, bit by bit;
    progress is told, and nothing is held by the workers afterwards.
    """
    here = ml.ConstraintLearner(features, **HELD).fit(source)
    assert any("chosen evenly out of 4,000 of 40" in note for note in here.report_.notes)
    victims = list(client.run(os.getpid).values())
    told: dict[str, list[float]] = {}

    def tell_and_kill(step: str, share: float) -> None:
        if not told:
            os.kill(victims[0], signal.SIGKILL)
        told.setdefault(step, []).append(share)

    there = ml.ConstraintLearner(features, **HELD).fit(source, client=client, progress=tell_and_kill)
    client.wait_for_workers(2, timeout=60)
    assert victims[0] not in client.run(os.getpid).values()
    np.testing.assert_array_equal(there.constraint_.selection, here.constraint_.selection)
    assert there.report_.uncertainty_deg == here.report_.uncertainty_deg
    assert there.report_.notes == here.report_.notes
    assert told["reading"] == sorted(told["reading"]) and told["reading"][-1] == 1.0
    deadline = threading.Event()
    while any("EvenChoice" in str(key) for keys in client.has_what().values() for key in keys):
        assert not deadline.wait(0.05)  # the scheduler lets go a moment later; the test's own limit ends it


def test_only_this_machine_can_reach_the_cluster(client):
    """Scheduler, workers and dashboard listen on the loopback address only."""
    info = client.scheduler_info(n_workers=-1)
    addresses = [info["address"], *info["workers"], *(w["nanny"] for w in info["workers"].values())]
    assert all("//127.0.0.1:" in address for address in addresses)
    assert "//127.0.0.1:" in client.dashboard_link


def test_errors_of_workers_come_back(client, features, source, tmp_path):
    """A recording that a worker refuses ends the fit with the same sentence as without a cluster; workers that die
    again and again end a command with one.
    """
    with (tmp_path / "demo_020.npz").open("wb") as file:
        np.savez(file, time=np.arange(9.0), q=np.full((9, 7), np.nan), joint_names=np.array(features.robot.joint_names))
    here, there = (
        str(pytest.raises(RecordingError, ml.ConstraintLearner(features, **HELD).fit, source, client=reader).value)
        for reader in (None, client)
    )
    assert here == there and "demo_020" in here
    settings = {"distributed.scheduler.allowed-failures": 0}
    with pytest.raises(ManipLearnError, match="is there enough memory"), dask.config.set(settings):
        with dask_client("local", 1) as frail:
            list(map_parts(os._exit, [1, 1], frail, None))


def test_command_line(client, features, source, tmp_path, capsys):
    """`--dask ADDRESS` reads on that scheduler; options that work on recordings in memory are refused beside it."""
    files = list(map(str, sorted(tmp_path.iterdir())[:20]))
    words = ["learn", "sawyer", *files, "--frame", "right_gripper_tip", "--reference", "world", "--json"]
    assert main([*words, "--dask", client.scheduler.address]) == 0
    here = ml.ConstraintLearner(features).fit(ml.load_demonstrations(files, features.robot)).constraint_
    assert json.loads(capsys.readouterr().out)["selection"] == here.selection.tolist()
    assert main([*words, "--dask", "local", "--html", "page.html"]) == 2
    assert "give one of the two" in capsys.readouterr().err


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "tls://127.0.0.1:9", "nowhere", ""])
def test_without_a_scheduler(monkeypatch, address: str):
    """Nobody at the address, or a way there that is not set up: one sentence that says so, and what to do."""
    monkeypatch.setattr("manip_learn.learning.table.PATIENCE", "1s")
    with pytest.raises(ManipLearnError, match="start one with `dask scheduler`"), dask_client(address):
        pass
    gc.collect()  # a client that failed closes as it is collected, for which it waits if another one is starting then


def test_without_the_extra(monkeypatch):
    """Without dask, `--dask` names the extra that brings it."""
    monkeypatch.setitem(sys.modules, "dask.distributed", None)
    with pytest.raises(MissingExtraError, match="dask"), dask_client("local"):
        pass
