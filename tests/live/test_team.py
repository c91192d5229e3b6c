"""Further platforms of a live run: newest pictures, by the clock of the machine, whatever happens to any of them."""

import itertools
import math
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.control.test_ground_team import CAMERA
from tests.geo.test_fusion import aerial
from tests.live.streams import PATIENCE_S, FakeStream, grey
from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.live import Health
from torchvision_dddas.live.team import LiveTeam
from torchvision_dddas.types import Detections, FrameResult, People, TrackedFrame, Tracks

BOX = np.array([[605.0, 455.0, 70, 175]])
PERSON = People(BOX, np.array([0.95]), np.ones(1), np.zeros(1, bool), BOX)  # 10 m ahead, at east = north = 0


@pytest.fixture
def streams(monkeypatch):
    """Addresses by the name of their host: a script of pictures, or a reason why it cannot be opened."""
    scripts: dict[str, Any] = {}

    def opened(target, name, *_):
        script = scripts[target.split("/")[2]]
        if isinstance(script, str):
            raise InputError(script)
        return FakeStream(script)

    for module in ("capture", "refusal"):
        monkeypatch.setattr(f"torchvision_dddas.live.{module}.open_stream", opened)
    monkeypatch.setattr("torchvision_dddas.live.refusal.answered_status", lambda *_: None)
    monkeypatch.setattr("torchvision_dddas.control.ground_team.load_scorer", lambda *_: object())
    return scripts


def endless(width=1280):
    return (step for _ in itertools.count() for step in (lambda: time.sleep(0.02), grey(90, width, 960)))


def main_clip(is_stream=True):
    return SimpleNamespace(is_stream=is_stream, start_utc_s=time.time())


def team_of(folder, names, source, **changes):
    for name in names:
        content = f'clip = "rtsp://{name}/live"\nrate_hz = 25\n{CAMERA.format(north=-10.0)}'
        (folder / f"{name}.toml").write_text(content)
    settings = with_parameters(Settings(), {"fusion.delay_s": 0.3, "live.retry_s": 0.01, **changes})
    watch: Any = SimpleNamespace(locator=SimpleNamespace(site=SimpleNamespace(origin_deg=None, telemetry=None)))
    health = Health()
    team = LiveTeam(([folder / f"{name}.toml" for name in names], ()), settings, "onboard", watch, source, health)
    team.begin(folder)
    return team, health


def fly(team, source, is_over):
    """Main results in real time until something is so."""
    found: list[FrameResult] = []
    until_s = time.monotonic() + PATIENCE_S
    while not is_over(found):
        assert time.monotonic() < until_s, "nothing happens any more"
        located = aerial(time.time() - source.start_utc_s, ((0.0, 0.0), (30.0, 0.0)))
        found.append(team.add(FrameResult(TrackedFrame(len(found) + 1, None, Detections(), Tracks(1)), located)))
        time.sleep(0.02)
    return found


def shared(health):
    return {name: facts["shared"] for name, facts in health.snapshot().platforms.items()}


def test_one_platform_confirms_and_is_fused_while_others_are_lost_or_absent_or_of_another_size(
    streams, tmp_path, monkeypatch
):
    monkeypatch.setattr("torchvision_dddas.control.ground_team.detect_people", lambda *_: [PERSON])
    lost = itertools.chain(itertools.islice(endless(), 60), [False] * 20, itertools.repeat(False))
    streams.update(good=endless(), lost=lost, absent="no route to it", small=endless(640))
    source = main_clip()
    team, health = team_of(tmp_path, streams, source)

    def is_over(found):
        streams["lost"] = "no route to it"
        states = {name: facts["state"] for name, facts in health.snapshot().platforms.items()}
        both = any({"uav", "good"} <= set(seen) for one in found if one.fused for seen in one.fused.seen_by)
        return both and states["lost"] == "sends no pictures" and "640 x 960" in states["small"]

    found = fly(team, source, is_over)
    trouble = "; ".join(health.snapshot().troubles)
    assert all(name in trouble for name in ("lost: ", "absent: ", "small: ")) and "good" not in trouble
    notes = "\n".join(team.finish())
    assert found[-1].confirmed.kind == ("human", "unseen")
    assert "absent was not used" in notes and "small: pictures of small have 640 x 960 px" in notes
    assert {"fused.csv", "confirmed.csv"} <= {path.name for path in tmp_path.iterdir()}
    assert not any(thread.is_alive() for thread in team._threads)


def test_starts_s_of_a_stream_is_how_late_its_pictures_come(streams, tmp_path, monkeypatch):
    monkeypatch.setattr("torchvision_dddas.control.ground_team.detect_people", lambda *_: [PERSON])
    streams.update(ugv1=endless())
    source = main_clip()
    team, _ = team_of(tmp_path, streams, source, **{"aerial.clock_offset_s": 0.4})
    platform = team._team.platforms[0]
    picture = SimpleNamespace(start_utc_s=source.start_utc_s + 7.0)
    assert math.isclose(team._shift_s(platform, picture), 7.4, abs_tol=1e-6)
    team._team.starts_s["ugv1"] = -0.3
    assert math.isclose(team._shift_s(platform, picture), 7.1, abs_tol=1e-6)
    team.finish()


def test_looks_that_come_after_the_last_main_result_are_counted(streams, tmp_path, monkeypatch):
    monkeypatch.setattr("torchvision_dddas.control.ground_team.detect_people", lambda *_: [PERSON])
    streams.update(ugv1=endless())
    team, _ = team_of(tmp_path, streams, main_clip())
    until_s = time.monotonic() + PATIENCE_S
    team.add(FrameResult(TrackedFrame(1, None, Detections(), Tracks(1)), aerial(100.0, ((0.0, 0.0), (30.0, 0.0)))))
    while not team._looks["ugv1"] and time.monotonic() < until_s:
        time.sleep(0.01)
    notes = "\n".join(team.finish())
    assert "ugv1: records not fused for lack of time" in notes and "worked on before the last result" in notes


def test_work_that_fails_ends_its_platform_alone_and_is_noted(streams, tmp_path, monkeypatch):
    def detect(*_):
        raise ValueError("no picture will do")

    monkeypatch.setattr("torchvision_dddas.control.ground_team.detect_people", detect)
    streams.update(ugv1=endless())
    source = main_clip()
    team, health = team_of(tmp_path, streams, source)
    found = fly(team, source, lambda found: "no picture will do" in "".join(health.snapshot().troubles))
    assert found and any("ValueError: no picture will do" in note for note in team.finish())


@pytest.mark.parametrize("is_stream", [True, False])
def test_a_run_takes_platforms_of_its_own_kind_alone(streams, tmp_path, is_stream):
    streams.update(ugv1=endless())
    if is_stream:
        team_of(tmp_path, streams, main_clip())[0].finish()
    else:
        with pytest.raises(InputError, match="the main clip is recorded, but ugv1 is live"):
            team_of(tmp_path, streams, main_clip(False))
