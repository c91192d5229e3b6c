"""Settings: every parameter is described, every mistake gets one line, every shipped configuration loads."""

import tomllib
from pathlib import Path
from typing import Annotated

import pytest
from hypothesis import HealthCheck, given
from hypothesis import settings as examples
from hypothesis import strategies as st
from pydantic import Field, ValidationError

from torchvision_dddas.config import (
    Group,
    Parameter,
    Settings,
    all_parameters,
    changes,
    format_toml,
    is_set,
    load_config,
    parameter,
    range_of,
    read_toml,
    with_parameters,
)
from torchvision_dddas.errors import InputError

CONFIGS = sorted((Path(__file__).parents[1] / "configs").glob("*.toml"))
KNOBS = {row.name: row for row in all_parameters()}


@pytest.mark.parametrize("row", all_parameters(), ids=lambda row: row.name)
def test_every_parameter_has_unit_range_and_meaning(row: Parameter) -> None:
    assert row.unit
    assert len(row.meaning.split()) >= 3
    assert "None" not in row.range
    assert " to " in row.range or " or " in row.range


def test_every_parameter_of_every_group_is_listed() -> None:
    content = Settings().model_dump()
    assert [f"{group}.{name}" for group, parameters in content.items() for name in parameters] == list(KNOBS)


def test_every_default_lies_in_its_own_range() -> None:
    assert with_parameters(Settings(), {name: row.default for name, row in KNOBS.items()}) == Settings()


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_a_shipped_configuration_loads_and_holds_only_what_differs_from_the_defaults(path: Path) -> None:
    written = {
        f"{group}.{name}" for group, parameters in tomllib.loads(path.read_text()).items() for name in parameters
    }
    assert written == set(changes(load_config(path.stem)))


def test_overrides_win_over_the_file_and_the_file_over_the_defaults(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("[registration]\nkeypoints = 300\nlevels = 2\n")
    settings = load_config(path, ["registration.keypoints=400", "registration.model=affine", "interval.rule=false"])
    assert changes(settings) == {
        "registration.model": "affine",
        "registration.keypoints": 400,
        "registration.levels": 2,
        "interval.rule": False,
    }


def test_a_list_of_numbers_can_be_a_parameter() -> None:
    class Gaps(Group):
        gaps: tuple[Annotated[int, Field(ge=1, le=30)], ...] = parameter((1, 2), "how far to look back", "frames")

    assert range_of(Gaps.model_fields["gaps"]) == "a list of 1 to 30"
    with pytest.raises(ValidationError):
        Gaps(gaps=(1, 31))


@pytest.mark.parametrize(("text", "number"), [(".5", 0.5), ("1.", 1.0), ("+.25", 0.25)])
def test_numbers_may_begin_or_end_with_their_point(text: str, number: float) -> None:
    assert load_config(None, [f"track.hiding={text}"]).track.hiding == number


@pytest.mark.parametrize(
    ("override", "wanted"),
    [
        ("registration.keypoint=3", ["registration.keypoint'", "registration.keypoints"]),
        ("keypoints=3", ["did you mean registration.keypoints"]),
        ("nowhere.zzzz=3", ["unknown parameter 'nowhere.zzzz'", "dddas settings"]),
        ("registration=3", ["unknown parameter 'registration'"]),
        (
            "registration.keypoints=9000",
            ["registration.keypoints must be a whole number between 50 and 5000 points, got 9000"],
        ),
        ("registration.keypoints=1.5", ["1.5", "a whole number"]),
        ("registration.keypoints=many", ["got 'many'", "between 50 and 5000 points"]),
        ("registration.keypoints=true", ["True", "a whole number"]),
        ("registration.block_px=4", ["block_px must be a whole number between 3 and 15 px, odd, got 4"]),
        ("registration.quality=nan", ["nan", "between 0.0001 and 0.5"]),
        ("difference.near_frames=[]", ["near_frames", "a list of 1 to 30 frames"]),
        ("difference.near_frames=[0]", ["near_frames must be a list of 1 to 30 frames, got 0"]),
        ("registration.model=plane", ["'plane'", "homography or affine"]),
        ("aerial.grid=ups", ["'ups'", "nothing or mgrs or utm"]),
        ("interval.rule=1", ["true or false"]),
        ("interval.minimum_frames=50", ["minimum_frames = 50", "above maximum_frames"]),
        ("people.block_px=12", ["people: block_px = 12 is not a multiple of cell_px = 8"]),
        ("people.window_width_px=60", ["do not fill window_width_px = 60; wanted 16 + a multiple of 8"]),
        ("people.window_height_px=8", ["do not fill window_height_px = 8"]),
        ("gates.min_size_m=90", ["min_size_m", "above max_size_m"]),
        ("registration.keypoints", ["not an override", "group.parameter=value"]),
        ("=3", ["not an override"]),
    ],
)
def test_a_mistaken_override_gets_one_line_that_says_what_was_wanted(override: str, wanted: list[str]) -> None:
    with pytest.raises(InputError) as error:
        load_config(None, [override])
    line = str(error.value)
    for part in wanted:
        assert part in line


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("[registration]\nkeypoints = = 3\n", ["line 2", "not valid TOML"]),
        ("[registration]\nkeypoints = [\n", ["end of document", "not valid TOML"]),
        ("keypoints = 300\n", ["outside of a [group]", "registration.keypoints"]),
        ("[registration]\nkeypoint = 300\n", ["unknown parameter", "registration.keypoints"]),
        ("[registration]\nkeypoints = 1\n", ["registration.keypoints must be", "between 50 and 5000 points, got 1"]),
    ],
)
def test_a_mistake_in_a_file_names_the_file(tmp_path: Path, text: str, wanted: list[str]) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(InputError) as error:
        load_config(path)
    line = str(error.value)
    for part in [str(path), *wanted]:
        assert part in line


def test_an_unknown_configuration_lists_those_that_there_are(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"'sauce'.*fast.*source"):
        load_config("sauce")
    with pytest.raises(InputError, match="no such configuration file"):
        load_config(tmp_path / "absent.toml")


def test_settings_have_a_json_schema_with_meanings_and_ranges() -> None:
    schema = Settings.model_json_schema()["$defs"]["RegistrationParameters"]["properties"]["keypoints"]
    assert (schema["minimum"], schema["maximum"], schema["unit"]) == (50, 5000, "points") and schema["description"]


ANY_TEXT = st.text(
    st.characters(codec=None, categories=None) | st.sampled_from("\r\n\x00\x1b\x7f\x85\u2028\ud800\udcff\"'\\#,[]")
)
ANY_TABLE = st.recursive(
    ANY_TEXT, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(ANY_TEXT, inner, max_size=3), max_leaves=6
)


def whole(value):
    """The same with half characters as text."""
    if isinstance(value, dict):
        return {whole(key): whole(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [whole(inner) for inner in value]
    return "".join(f"\\u{ord(letter):x}" if "\ud800" <= letter <= "\udfff" else letter for letter in value)


@given(content=st.dictionaries(ANY_TEXT, ANY_TABLE, max_size=3), comment=ANY_TEXT)
@examples(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_toml_of_any_unicode_text_and_comment_is_read_as_it_was_written(tmp_path: Path, content, comment) -> None:
    path = tmp_path / "any.toml"
    path.write_bytes(format_toml(content, [comment]).encode())
    assert read_toml(path) == whole(content)


def test_pauses_before_a_stream_is_opened_again_cannot_shrink():
    with pytest.raises(InputError, match=r"retry_most_s = 1 is below retry_s = 4"):
        load_config(None, ["live.retry_s=4", "live.retry_most_s=1"])


def test_a_value_that_is_set_counts_as_set_also_where_it_is_the_default(tmp_path: Path) -> None:
    (tmp_path / "own.toml").write_text("[gates]\nfocal_px = 1000\n")
    name = "gates.focal_px"
    assert not is_set(load_config("fast", ["gates.min_area_px=80"]), name)
    for settings in (load_config(tmp_path / "own.toml"), load_config(None, [f"{name}=1000"])):
        assert is_set(settings, name) and settings == Settings()
        assert is_set(with_parameters(settings, {"track.doubt": 3.0}), name)
