from __future__ import annotations

from pathlib import Path

import pytest

from tests.bag.sample import write_sample


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write_sample(tmp_path / "passage")
