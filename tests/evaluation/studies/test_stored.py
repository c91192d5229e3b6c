"""Records as bytes: what is stored comes back to the last digit, and nothing else does."""

import io
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchvision_dddas.evaluation.metrics.pixels import Pixels
from torchvision_dddas.evaluation.studies.record import Found
from torchvision_dddas.evaluation.studies.scored import Scored
from torchvision_dddas.evaluation.studies.stored import DamagedError, packed, unpacked


def found():
    rng = np.random.default_rng(0)
    return Found(
        np.array([1, 1, 4]),
        rng.random((3, 4)),
        rng.random(3),
        np.array([7, -1, 7]),
        np.full((3, 2), np.nan),
        np.full((3, 2, 2), np.nan),
        np.array([1, 2, 4]),
        {2: b"\x89PNG", 4: b""},
        {4: np.eye(3) * np.pi},
        {"speed_px": rng.random(3)},
        {"read": 0.1, "track": 1e-300},
        float("nan"),
        ("a note – with signs",),
    )


def test_a_result_comes_back_to_the_last_digit() -> None:
    there, back = found(), unpacked(packed(found()))
    assert isinstance(back, Found)
    for name, value in vars(there).items():
        again = getattr(back, name)
        if isinstance(value, np.ndarray):
            assert again.dtype == value.dtype and again.tobytes() == value.tobytes(), name
        elif name == "steps":
            assert again.keys() == value.keys() and (again[4] == value[4]).all()
        elif name == "more":
            assert (again["speed_px"] == value["speed_px"]).all()
        elif name == "peak_mb":
            assert np.isnan(again)
        else:
            assert again == value, name


def test_counts_come_back_as_the_kind_that_they_were() -> None:
    scored = Scored(np.array([1, 2]), {"pixels": Pixels(1, 2, 3, 4)}, {"pixels": {"tp": np.array([1.0, np.nan])}})
    back = unpacked(packed(scored))
    assert type(back.counts["pixels"]) is Pixels and back.counts["pixels"] == Pixels(1, 2, 3, 4)
    assert back.counts["pixels"].plus(Pixels(1)).tp == 2


WHOLE = packed(found())


@given(st.integers(0, len(WHOLE) - 1), st.integers(1, 255))
def test_any_changed_byte_is_noticed(place: int, change: int) -> None:
    damaged = bytearray(WHOLE)
    damaged[place] ^= change
    with pytest.raises(DamagedError):
        unpacked(bytes(damaged))


@given(st.integers(0, len(WHOLE) - 1))
def test_any_lost_end_is_noticed(length: int) -> None:
    with pytest.raises(DamagedError):
        unpacked(WHOLE[:length])


@pytest.mark.parametrize(
    "name",
    [
        "os:system",
        "torchvision_dddas.cli:main",
        "torchvision_dddas.evaluation.studies.stored:json",
        "torchvision_dddas.x:y",
    ],
)
def test_what_is_no_record_of_this_package_is_never_made(name: str) -> None:
    import hashlib

    content = json.dumps({"of": name, "fields": {"command": "true"}}).encode()
    file = io.BytesIO()
    np.savez(file, content=np.frombuffer(content, np.uint8))
    body = file.getvalue()
    with pytest.raises(DamagedError):
        unpacked(hashlib.sha256(body).digest() + body)


def test_what_cannot_be_stored_is_refused_by_its_name() -> None:
    with pytest.raises(TypeError, match="a set cannot be stored"):
        packed({"a": {1, 2}})
