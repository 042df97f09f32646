"""A dataset on a real Dask scheduler and two real workers, one of which is killed while it works."""

import importlib.util
import json
import subprocess
import sys
import time

import pytest

from solver import InputError
from trackvib_ros.dataset import make_dataset
from trackvib_ros.dataset_spec import Spec

SHORT = """
line = { approach_left = 10.0, spans = [20.0], approach_right = 10.0 }
solution = { frequency_limit = 500.0, step = 2.5e-4 }
channel = [{ name = "rail_a", layer = "rail", x = 10.0 }]
sensor = [{ channel = "rail_a", preset = "rail_500g", rate = 1000, bandwidth = 400.0 }]
"""
TABLE = {
    "scenarios": ["short.toml"],
    "trains": ["metro"],
    "snr_db": [20],
    "repeats": 6,
    "seed": 3,
}


def wait_for(condition, what, seconds=60.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.02)


def test_address_needs_a_port(tmp_path):
    pytest.importorskip("distributed", reason="needs Dask: pip install '.[cluster]'")
    with pytest.raises(InputError, match="must end with a port"):
        make_dataset(Spec(), tmp_path / "set", scheduler="somewhere")
    assert not (tmp_path / "set").exists()


@pytest.mark.slow
@pytest.mark.skipif(
    importlib.util.find_spec("distributed") is None,
    reason="needs Dask: pip install '.[cluster]'",
)
def test_a_killed_worker_loses_and_doubles_nothing(tmp_path):
    (tmp_path / "short.toml").write_text(SHORT, "utf-8")
    spec = Spec.from_table(TABLE, "set.toml", tmp_path)
    elsewhere = tmp_path / "elsewhere"  # the workers' folder is not the client's
    elsewhere.mkdir()
    file = tmp_path / "scheduler.json"
    dask = [sys.executable, "-m", "distributed.cli.dask_"]
    local = ["--scheduler-file", str(file), "--no-dashboard"]
    worker = [*dask[:2], dask[2] + "worker", *local, "--no-nanny", "--nthreads", "1"]
    scheduler = [*dask[:2], dask[2] + "scheduler", *local, "--host", "127.0.0.1", "--port", "0"]
    processes = [
        subprocess.Popen(command, cwd=elsewhere, stderr=subprocess.DEVNULL)
        for command in (scheduler, worker, worker)
    ]
    try:
        wait_for(lambda: file.exists() and file.read_text().endswith("}"), "no scheduler")
        address = json.loads(file.read_text())["address"]
        from distributed import Client

        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)
        told = []

        def step(done, total, name):
            told.append(name)
            if len(told) == 2:
                processes[1].kill()

        outcome = make_dataset(spec, tmp_path / "set", scheduler=address, progress=step)
    finally:
        for process in processes:
            process.kill()
            process.wait()
    names = sorted(case.name for case in spec.expand())
    assert sorted(outcome) == names and len(told) == len(names)
    assert set(outcome.values()) <= {"made", "there"}
    found = sorted(path.name for path in (tmp_path / "set").iterdir())
    assert found == [*names, "dataset.json"]

    # the same bytes as without a cluster: no bag is torn, and where it was made does not matter
    make_dataset(spec, tmp_path / "local", workers=1)
    for name in names:
        for path in (tmp_path / "local" / name).iterdir():
            assert (tmp_path / "set" / name / path.name).read_bytes() == path.read_bytes()
