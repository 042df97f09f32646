from __future__ import annotations

from pathlib import Path

import pytest

from solver import InputError
from trackvib_ros.figures import FIGURES, claims, draw, output_paths, study


def test_the_papers_figures_are_drawn_into_a_new_folder_and_never_over_files(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "new" / "figures"
    found = study(2)
    paths = draw(found, folder)
    assert [path.stem for path in paths] == [*FIGURES, "claims"]
    for path in paths[:-1]:
        assert path.read_bytes().startswith(b"\x89PNG")
    text = paths[-1].read_text("utf-8")
    assert all(claim.found.split("\n")[0][:40] in text for claim in claims(found))
    with pytest.raises(InputError, match="exists already, not overwriting"):
        output_paths(folder)


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "figures").write_text("mine")
    with pytest.raises(InputError, match="is a file, not a folder"):
        output_paths(tmp_path / "figures")
