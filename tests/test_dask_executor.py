"""Learning on a dask cluster: a real scheduler, real worker processes, and one of them killed."""

from __future__ import annotations

import gc
import os
import re
import signal
import sys
import time

import numpy as np
import pytest
from scale_motions import motions

from manip_learn.cli import main
from manip_learn.constraint.features import FrameJacobian
from manip_learn.errors import ManipLearnError, MissingExtraError, RecordingError
from manip_learn.learning import ConstraintLearner, learner
from manip_learn.linalg import orthonormal_rows
from manip_learn.recordings import RecordingSource, trajectory_source
from manip_learn.robot.loading import load_robot

pytest.importorskip("distributed", reason="the extra 'dask' is not installed")
from distributed import Client

from manip_learn.learning.streaming import dask_executor
from manip_learn.learning.streaming.dask_executor import dask_client  # noqa: E402

TWO = orthonormal_rows(np.array([[1.0, 0.2, 0.3], [-0.3, 0.9, 0.2]]))
HELD = {"n_constraints": 2, "estimator": "null-space"}
JOINT = {"n_constraints": 2, "estimator": "joint", "policy_model": "affine"}
# the cluster's own clean-up of sockets and processes is not ours to judge
pytestmark = [pytest.mark.filterwarnings("ignore::ResourceWarning"), pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def features() -> FrameJacobian:
    return FrameJacobian(load_robot("sawyer"), "right_gripper_tip", "xyz")


@pytest.fixture(scope="module")
def client():
    """Two worker processes on this machine."""
    with dask_client("local", 2) as client:
        assert len(client.scheduler_info(n_workers=-1)["workers"]) == 2
        yield client


@pytest.fixture(autouse=True)
def small_parts(monkeypatch):
    """Many parts of few samples, and an answer from few to begin with."""
    monkeypatch.setattr(trajectory_source, "PART", 700)
    monkeypatch.setattr(learner, "IN_MEMORY_SAMPLES", 1000)


def test_the_number_of_workers_does_not_matter(features):
    """One, two and three workers give the same Lambda bit by bit, and a single process the same to rounding."""
    cases = [
        (motions(features, TWO, np.random.default_rng(1), 30, noise=0.02, held=s is HELD), s) for s in (HELD, JOINT)
    ]
    found = []
    with dask_client("local", 3) as client:
        for n in (3, 2, 1):
            client.cluster.scale(n)
            wait_for(lambda n=n: len(client.scheduler_info(n_workers=-1)["workers"]) == n)
            found.append([ConstraintLearner(features, **s).fit(demos, client=client) for demos, s in cases])
    for (demos, settings), *learners in zip(cases, *found, strict=True):
        for learnt in learners:
            np.testing.assert_array_equal(learnt.constraint_.selection, learners[0].constraint_.selection)
            assert learnt.report_.uncertainty_deg == learners[0].report_.uncertainty_deg
            assert learnt.report_.n_trajectories == 30
        alone = ConstraintLearner(features, **settings).fit(demos)
        np.testing.assert_allclose(alone.constraint_.selection, learners[0].constraint_.selection, atol=1e-12)


def wait_for(condition):
    """What the scheduler does a moment later."""
    deadline = time.monotonic() + 20.0
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert condition()


def test_a_killed_worker_changes_nothing(client, features):
    """A worker that is killed in the middle of a pass is replaced, and the answer is the same bit by bit."""
    demos = motions(features, TWO, np.random.default_rng(2), 30, noise=0.02, held=True)
    quiet = ConstraintLearner(features, **HELD).fit(demos, client=client).constraint_
    victims = list(client.run(os.getpid).values())
    killed: list[int] = []

    def kill_one(step: str, share: float) -> None:
        if re.search("pass 1", step) and not killed:
            killed.append(victims[0])
            os.kill(victims[0], signal.SIGKILL)

    disturbed = ConstraintLearner(features, **HELD).fit(demos, client=client, progress=kill_one).constraint_
    assert killed
    client.wait_for_workers(2, timeout=60)
    assert victims[0] not in client.run(os.getpid).values()
    np.testing.assert_array_equal(disturbed.selection, quiet.selection)


def test_only_this_machine_can_reach_the_cluster(client):
    """Scheduler, workers and dashboard listen on the loopback address only."""
    info = client.scheduler_info(n_workers=-1)
    addresses = [info["address"], *info["workers"], *(w["nanny"] for w in info["workers"].values())]
    assert all("//127.0.0.1:" in address for address in addresses)
    assert "//127.0.0.1:" in client.dashboard_link


def held_keys(client):
    """Our results that workers still hold."""
    return [key for keys in client.has_what().values() for key in keys if "manip-learn" in str(key)]


def test_progress_is_told(client, features):
    """Each pass tells its share up to 1; nothing is held by the workers afterwards."""
    demos = motions(features, TWO, np.random.default_rng(3), 30, noise=0.02, held=True)
    told: dict[str, list[float]] = {}

    def tell(step: str, share: float) -> None:
        told.setdefault(step, []).append(share)

    ConstraintLearner(features, **HELD).fit(demos, client=client, progress=tell)
    assert len(told) >= 3
    for shares in told.values():
        assert shares == sorted(shares) and shares[-1] == 1.0 and len(shares) > 3
    # the scheduler tells the workers to forget a moment after the client has let go
    wait_for(lambda: not held_keys(client))


def test_errors_of_workers_come_back(client, features):
    """A recording that a worker refuses ends the fit with the same sentence as without a cluster."""
    demos = motions(features, TWO, np.random.default_rng(4), 30, held=True)

    class Broken(trajectory_source.TrajectorySource):
        n_parts = 1

        def part(self, index, notes=None):
            raise RecordingError("no good")

    with pytest.raises(RecordingError, match="no good"):
        ConstraintLearner(features, **HELD).fit(Broken(), client=client)
    assert ConstraintLearner(features, **HELD).fit(demos, client=client).report_.n_samples == 3000


def test_a_folder_of_episodes(client, features, tmp_path, monkeypatch):
    """Workers read the files themselves; the answer is that of the same source in this process."""
    from manip_learn.recordings import recording_source

    monkeypatch.setattr(recording_source, "PART_BYTES", 50_000)
    demos = motions(features, TWO, np.random.default_rng(5), 40, noise=0.02, held=True)
    for i, t in enumerate(demos):
        np.savez(tmp_path / f"demo_{i}.npz", time=t.time, q=t.q, u=t.u, joint_names=np.array(t.joint_names))
    source = RecordingSource(tmp_path, features.robot)
    assert source.n_parts > 5
    here = ConstraintLearner(features, **HELD).fit(source).constraint_.selection
    there = ConstraintLearner(features, **HELD).fit(source, client=client).constraint_.selection
    np.testing.assert_allclose(there, here, atol=1e-12)


def test_command_line(client, features, tmp_path, capsys):
    """`--dask ADDRESS` learns on that scheduler; an address without a scheduler gives one sentence and exit code 2."""
    demos = motions(features, TWO, np.random.default_rng(6), 20, noise=0.02, held=True)
    for i, t in enumerate(demos):
        np.savez(tmp_path / f"demo_{i}.npz", time=t.time, q=t.q, u=t.u, joint_names=np.array(t.joint_names))
    words = ["learn", "sawyer", str(tmp_path), "--frame", "right_gripper_tip", "--reference", "world", "--json"]
    assert main([*words, "--dask", client.scheduler.address]) == 0
    there = capsys.readouterr().out
    assert main(words) == 0
    here = capsys.readouterr().out
    selections = [re.search(r'"n_constraints": (\d)', text).group(1) for text in (there, here)]  # type: ignore[union-attr]
    assert selections == ["2", "2"]
    assert main([*words, "--dask", "local", "--points", "5"]) == 2
    assert "give one of the two" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("address", "advice"),
    [
        ("tcp://127.0.0.1:9", "at 'tcp://127.0.0.1:9' .*: start one with `dask scheduler`, or use 'local'$"),
        ("tls://127.0.0.1:9", "tls needs certificates in dask's settings"),
        ("ucx://127.0.0.1:9", "ucx needs packages and settings of its own; use tcp://HOST:PORT"),
        ("ws://127.0.0.1:9", "ws needs packages"),
        ("nowhere", "missing port number.*start one with `dask scheduler`"),
        ("", "at ''.*start one with `dask scheduler`"),
    ],
)
def test_without_a_scheduler(monkeypatch, address: str, advice: str):
    """Nobody at the address, or a way there that is not set up: one sentence that says so, and what to do."""
    monkeypatch.setattr(dask_executor, "PATIENCE", "1s")
    before = sum(type(x) is Client for x in gc.get_objects())
    with pytest.raises(ManipLearnError, match=advice), dask_client(address):
        pass
    # a client that is half made closes itself when it is collected, which may wait for ever
    assert sum(type(x) is Client for x in gc.get_objects()) <= before


def test_without_the_extra(features, monkeypatch):
    """Without dask, a client or `--dask` names the extra that brings it."""
    monkeypatch.setitem(sys.modules, "dask.distributed", None)
    monkeypatch.delitem(sys.modules, "manip_learn.learning.streaming.dask_executor")
    demos = motions(features, TWO, np.random.default_rng(7), 5, held=True)
    with pytest.raises(MissingExtraError, match="dask"):
        ConstraintLearner(features).fit(demos, client=object())
