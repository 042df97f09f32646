import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from solver import InputError
from trackvib_ros.detection import Channel, Estimate, TrainEvent

plain = st.one_of(
    st.integers(-(2**62), 2**62),
    st.floats(allow_nan=False, allow_infinity=False),
    st.text(),
)
values = st.one_of(
    plain,
    st.builds(
        Estimate, st.floats(-1e9, 1e9), st.floats(0, 1e9), st.sampled_from(["m/s", "s", "m/s^2"])
    ),
    st.lists(st.one_of(plain, st.tuples(st.text(), st.floats(0, 1)))).map(tuple),
)


@given(
    values=st.dictionaries(st.from_regex(r"[a-z_]{3,12}", fullmatch=True), values, max_size=6),
    stamp=st.integers(-(2**62), 2**62),
    quality=st.lists(st.text()).map(tuple),
)
def test_event_survives_text_pairs(values, stamp, quality):
    reserved = {"kind", "stamp_ns", "sigma_s", "confidence", "method", "sensors", "quality"}
    values = {k: v for k, v in values.items() if k not in reserved}
    event = TrainEvent("passage", stamp, 0.25, 0.5, "axle pattern", ("a", "b"), values, quality)
    pairs = event.to_dict()
    assert all(isinstance(k, str) and isinstance(v, str) for k, v in pairs.items())
    assert TrainEvent.from_dict(json.loads(json.dumps(pairs))) == event


@pytest.mark.parametrize(
    ("change", "named"), [({"kind": None}, "kind"), ({"kind": "brunch"}, "brunch")]
)
def test_foreign_pairs_are_refused(change, named):
    pairs = TrainEvent("arrival", 0, 0.1, 1.0, "m", ("a",)).to_dict() | change
    pairs = {k: v for k, v in pairs.items() if v is not None}
    with pytest.raises(InputError, match=named):
        TrainEvent.from_dict(pairs)


def test_channel_names_its_layers():
    with pytest.raises(InputError, match=r"sleeper.*rail, slab"):
        Channel("a", 0.0, "sleeper")
    with pytest.raises(InputError, match="finite"):
        Channel("a", float("nan"))
