"""Scenarios: read by name or file, changed, written, and refused in one line that says what to do."""

import math

import pytest

from tests.lab.simulation.small import as_file, small
from torchvision_dddas.config import Settings, config_names, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.simulation import Scenario, load_scenario, scenario_names, scenario_settings
from torchvision_dddas.lab.simulation.scenario import check_scenario


@pytest.mark.parametrize("name", scenario_names())
def test_a_shipped_scenario_shows_its_landmarks_and_is_read_back_as_written(name, tmp_path):
    scenario = load_scenario(name, ["settings.crowds.join_m=4", "settings.steering.on=false"])
    camera, team, uav = scenario.camera, scenario.team, scenario.uav
    assert 6 <= scenario.clip.seconds <= 60
    if team.ugvs:
        assert len(scenario.about) > 20
        assert scenario.clip.seconds >= 30
        assert team.middle_m == uav.start_m
        side_m = 2 * uav.altitude_m * math.tan(math.radians(camera.hfov_deg / 2)) * camera.height_px / camera.width_px
        assert team.ring_m < 0.4 * side_m
    scenario = scenario.model_copy(update={"about": 'a "crowd"\nof \\ naïve \x7f people'})
    assert load_scenario(as_file(tmp_path / "again.toml", scenario)) == scenario


def test_there_is_a_scenario_for_each_behaviour_altitude_and_fault():
    wanted = {"joining", "splitting", "scattering", "random", "crossing", "border50", "border100", "border200"}
    assert wanted | {"four", "six", "gps", "faults", "quiet"} <= set(scenario_names())
    assert len({fault.what for fault in load_scenario("faults").fault}) == 8
    assert not set(scenario_names()) & set(config_names())


def test_overrides_change_what_they_name_and_nothing_else():
    plain = load_scenario("joining")
    given = ["uav.altitude_m=100", "crowd.2.people=20", "crowd.1.way_m=[[1, 2], [3.5, 4]]"]
    changed = load_scenario("joining", given, seed=77)
    assert (changed.uav.altitude_m, changed.crowd[1].people, changed.seed) == (100, 20, 77)
    assert list(changed.crowd[0].way_m) == [(1, 2), (3.5, 4)]
    assert load_scenario("joining", [f"uav.altitude_m={plain.uav.altitude_m}", "crowd.2.people=7"]) == plain


def test_an_override_can_bring_a_whole_list_or_parameters_of_the_system():
    scenario = load_scenario("quiet", ["fault=[{what='gust', time_s=3, seconds=1}]", "settings.crowds.join_m=4"])
    assert scenario.fault[0].what == "gust"
    assert with_parameters(Settings(), scenario_settings(scenario)).crowds.join_m == 4


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("uav.altitude_m=1", "uav.altitude_m must be between 2 and 2000 m, got 1"),
        ("crowd.1.peple=9", "unknown parameter 'crowd.1.peple'; did you mean crowd.1.people"),
        ("crowd.1.people=0.5", "crowd.1.people must be a whole number between 1 and 5000 people, got 0.5"),
        ("crowd.3.people=2", "'crowd.3.people' names no crowd; wanted crowd.1, crowd.2, ...; there are 2"),
        ("crowd.people=2", "'crowd.people' names no parameter; wanted a name such as crowd.1.people"),
        ("weather.rain=3", "unknown parameter 'weather'; its tables are clip, world, uav"),
        ("seed=-1", "seed must be a whole number from 0 to 2147483647, got -1"),
        ("crowd.1.start_m=3", "crowd.1.start_m must be two numbers, [east, north], got 3"),
        ("crowd.1.way_m=[[1, 2], 3]", "crowd.1.way_m must be a list of places"),
        ("happening.1.what=jump", "happening.1.what must be join or split or scatter"),
        ("settings.crowds.join_m=-3", "settings: crowds.join_m must be between 0 and 100 m, got -3"),
        ("uav.altitude_m", "is not an override; wanted group.parameter=value"),
        ("crowd.1.start_m=[116, 0]", "is outside the world; wanted within 118 m"),
        ("crowd.2.way_m=[[0, 0], [0, -119]]", "crowd.2.way_m = [0, -119] is outside the world"),
        ("team.ring_m=119", "team.middle_m = [0, 0] with 119 m about it is outside"),
        ("uav.way_m=[[0, 200]]", "uav.way_m = [0, 200] is outside"),
        ("team.ugvs=3", "team.ugvs must be 4 or more in a clip located by landmarks, got 3"),
        ("happening.1.crowds=[1, 3]", "happening.1.crowds names crowd 3, but there are 2 crowds"),
        ("happening.1.crowds=[1, 1]", "must name two or more crowds to join"),
        ("happening.1.time_s=40", "happening.1.time_s = 40 is after the end; clip.seconds = 40"),
        ("fault=[{what='gps_jump', vehicle=5}]", "fault.1.vehicle = 5 does not exist; wanted team.ugvs = 4 or less"),
        ("world.elevation=no.tif", "world.elevation: there is no file no.tif"),
        ("happening=[{what='split', crowds=[1, 1]}]", "happening.1.crowds = [1, 1] names a crowd twice"),
        ("camera.exposure_s=0.2", "is longer than the time between pictures; wanted 0.1 s or less"),
        ("world.origin_deg=[200, 0]", "world.origin_deg must be a longitude from -180 to 180 and a latitude from -85"),
    ],
)
def test_a_wrong_override_is_refused_in_one_line_that_says_what_is_wanted(override, line):
    with pytest.raises(InputError) as refusal:
        load_scenario("joining", [override])
    assert line in str(refusal.value)


def test_a_person_alone_cannot_split_and_few_vehicles_suffice_where_telemetry_locates():
    with pytest.raises(InputError, match="crowd 1 has one person and cannot split"):
        load_scenario("splitting", ["crowd.1.people=1"])
    assert load_scenario("quiet", ["team.ugvs=0", 'clip.located_by="telemetry"']).team.ugvs == 0
    check_scenario(Scenario())
    check_scenario(small(team={"ugvs": 4}, fault=({"what": "frozen", "time_s": 0.5, "vehicle": 9},)))


def test_an_unknown_scenario_is_refused():
    for name, line in (("Joining", "choose from border100, .* or give a TOML"), ("a/gone.toml", "no such scenario")):
        with pytest.raises(InputError, match=line):
            load_scenario(name)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("[uav\n", "is not valid TOML"),
        ("", "is empty; wanted tables such as [clip] and [[crowd]]"),
        ("[uav]\naltitude_m = 'high'\n", "odd.toml: uav.altitude_m must be between 2 and 2000 m, got 'high'"),
        ("[[uav]]\naltitude_m = 5\n", "must be a table"),
        ("[crowd]\npeople = 5\n", "must be a list of tables"),
        ("[settings.crowds]\njoin = 5\n", "odd.toml: settings: unknown parameter"),
        ("altitude_m = 5\n", "unknown parameter 'altitude_m'; did you mean uav.altitude_m"),
    ],
)
def test_a_bad_file_is_refused_by_its_name(tmp_path, text, line):
    path = tmp_path / "odd.toml"
    path.write_text(text)
    with pytest.raises(InputError) as refusal:
        load_scenario(path)
    assert str(path) in str(refusal.value)
    assert line in str(refusal.value)


def test_a_raster_beside_its_scenario_is_found_and_a_folder_of_a_scenarios_name_does_no_harm(tmp_path, monkeypatch):
    (tmp_path / "hills.tif").write_bytes(b"")
    path = tmp_path / "hilly.toml"
    path.write_text('[world]\nelevation = "hills.tif"\n')
    assert load_scenario(path).world.elevation == str(tmp_path / "hills.tif")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "joining").mkdir()
    assert load_scenario("joining").about
