"""How the processes of the command and of the nodes begin."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

STATUS = Path("/proc/self/status")
CODE = """
import sys
from trackvib_ros.start import command
sys.argv = ["trackvib", "--version"]
try:
    command()
except SystemExit:
    pass
print(open("/proc/self/status").read().split("Threads:")[1].split()[0])
"""


@pytest.mark.skipif(not STATUS.exists(), reason="threads are counted by /proc")
def test_numpy_keeps_to_one_thread():
    several = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS")
    environment = {name: value for name, value in os.environ.items() if name not in several}
    told = subprocess.run(
        [sys.executable, "-c", CODE], env=environment, capture_output=True, text=True, check=True
    )
    assert told.stdout.split()[-1] == "1"
