"""``trackvib info`` and ``trackvib recover`` as a user meets them; none of it needs ROS."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.bag import sample
from trackvib_ros.cli import main


def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *words: str) -> str:
    monkeypatch.setattr(sys, "argv", ["trackvib", *words])
    with pytest.raises(SystemExit) as end:
        main()
    captured = capsys.readouterr()
    return f"{end.value.code or 0}\n{captured.out}{captured.err}"


def test_info_tells_contents_and_integrity(
    bag: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    text = run(capsys, monkeypatch, "info", str(bag))
    assert text.startswith("0\n") and "every record is intact" in text
    for word in (sample.WAVEFORM, "sensor_msgs/msg/PointCloud2", "1.980 s", "seed      7"):
        assert word in text
    machine = json.loads(run(capsys, monkeypatch, "info", "--json", str(bag))[2:])
    assert machine["topics"][sample.WAVEFORM] == ["sensor_msgs/msg/PointCloud2", 100]
    assert run(capsys, monkeypatch, "info", "--scenario", str(bag)) == "0\nspeed = 83.3\n\n"


def test_damage_is_told_recovered_and_kept(
    bag: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = bag / "passage_0.mcap"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    told = run(capsys, monkeypatch, "info", str(bag))
    assert told.startswith("1\n") and "damaged" in told and "trackvib recover" in told
    assert path.read_bytes() == data, "looking does not change a bag"
    mended = run(capsys, monkeypatch, "recover", str(bag))
    assert mended.startswith("0\n") and "kept as passage_0.mcap.damaged" in mended
    assert (bag / "passage_0.mcap.damaged").read_bytes() == data
    assert run(capsys, monkeypatch, "info", str(bag)).startswith("0\n")
    assert "nothing to recover" in run(capsys, monkeypatch, "recover", str(bag))


def test_single_file_is_recovered_into_a_new_one(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    torn = tmp_path / "torn.mcap"
    torn.write_bytes((bag / "passage_0.mcap").read_bytes()[:-100])
    said = run(capsys, monkeypatch, "recover", str(torn))
    assert said.startswith("0\n") and "torn.recovered.mcap: 101 messages intact" in said
    again = run(capsys, monkeypatch, "recover", str(torn))
    assert again.startswith("2\n") and "not overwritten" in again


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("info", "nowhere"), "nowhere does not exist"),
        (("info", "TEXT"), "is not an MCAP file"),
        (("info", "EMPTY"), "is not a bag"),
        (("recover", "EMPTY"), "holds no .mcap file"),
        (("recover", "EMPTY", "-o", "x"), "-o is for a single .mcap file"),
    ],
)
def test_wrong_paths_are_told(
    words: tuple[str, ...],
    told: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "text.mcap").write_text("this is not a recording at all\n" * 5)
    (tmp_path / "empty").mkdir()
    places = {"TEXT": str(tmp_path / "text.mcap"), "EMPTY": str(tmp_path / "empty")}
    text = run(capsys, monkeypatch, *(places.get(word, word) for word in words))
    assert text.startswith("2\n") and told in " ".join(text.split())


def test_bags_need_no_ros(bag: Path) -> None:
    program = (
        "import sys; sys.modules['rclpy'] = None\n"
        "from pathlib import Path\n"
        "from trackvib_ros.bag import BagReader\n"
        "print(sum(1 for _ in BagReader(Path(sys.argv[1])).waveforms('/rail/waveform')))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(bag)], capture_output=True, text=True, check=True
    )
    assert done.stdout == "100\n"
