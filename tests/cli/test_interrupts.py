"""Signals end a command with their exit code, one line and whole files; a second run or a broken pipe costs none."""

import json
import os
import shlex
import signal
import subprocess
import sys
import textwrap
import time
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Event, Thread

import cv2
import numpy as np
import pytest

from tests.cli.conftest import bad, record
from tests.lab.evaluation.studies import world
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.interrupts import Stopped, is_stop, raising_signals, uninterrupted

ROOT = Path(__file__).resolve().parents[2]

# A command whose progress stops it in its third frame, until the signal comes.
PROGRAM = textwrap.dedent("""
    import time
    from contextlib import contextmanager
    from torchvision_dddas.cli import main, progress

    @contextmanager
    def stopping(*_):
        count = 0

        def tick():
            nonlocal count
            count += 1
            if count == 3:
                print("now", flush=True)
                time.sleep(60)

        yield tick

    progress.progress = stopping
    main()
""")


MAIN = "from torchvision_dddas.cli import main; main()"
TABLE = "".join(f"{n},-1,{4 + n},10,8,24,0.95,-1,-1,-1\n" for n in range(1, 6))


@contextmanager
def tracking(clip, tmp_path, *more, program=PROGRAM):
    """A run of `dddas track` that has written two frames and waits in the third."""
    (tmp_path / "det.txt").write_text(TABLE)
    words = ["track", str(clip), "--detections", str(tmp_path / "det.txt"), "--out", str(tmp_path / "out"), *more]
    call = [sys.executable, "-c", program, *words]
    with subprocess.Popen(call, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "now\n", process.communicate(timeout=60)[1]
        yield process
        process.kill()


def stopped(clip, tmp_path, *numbers, program=PROGRAM):
    """The exit code and the words of such a run that gets signals in its third frame."""
    with tracking(clip, tmp_path, "--quiet", program=program) as process:
        for number in numbers:
            process.send_signal(number)
        error = process.communicate(timeout=60)[1]
    return process.returncode, error


def run_program(program, *words, **options):
    call = [sys.executable, "-c", textwrap.dedent(program), *map(str, words)]
    return subprocess.run(call, cwd=ROOT, capture_output=True, text=True, timeout=60, **options)


KEPT = (143, "dddas: ended by SIGTERM; results up to here are kept\n")


@pytest.mark.parametrize(
    ("numbers", "codes"),
    [
        ([signal.SIGTERM], {143}),
        ([signal.SIGHUP], {129}),
        ([signal.SIGINT], {130}),
        ([signal.SIGTERM, signal.SIGHUP, signal.SIGTERM], {143, 129}),  # as systemd sends them
        ([signal.SIGINT, signal.SIGINT], {130}),
    ],
)
def test_signals_leave_whole_outputs_also_several_at_once(clip, tmp_path, numbers, codes):
    code, error = stopped(clip, tmp_path, *numbers)
    assert code in codes
    assert error.endswith("; results up to here are kept\n") and error.count("\n") == 1
    assert error.startswith("dddas: interrupted; " if codes == {130} else "dddas: ended by SIG")
    out = tmp_path / "out"
    kept = record(out)
    assert (kept["state"], kept["interrupted"], kept["frames"]["written"]) == ("interrupted", True, 3)
    assert {row.split(",")[0] for row in (out / "tracks.txt").read_text().splitlines()} <= {"1", "2", "3"}
    assert cv2.VideoCapture(str(out / "overlay.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 3
    assert not [path for path in out.rglob("*") if path.name.startswith(".") or ".part" in path.name]


@pytest.mark.parametrize("lost", ["SystemError('an exception set') from error", "ImportError('no luck') from None"])
def test_a_signal_that_a_library_turns_into_another_exception_leaves_whole_outputs(clip, tmp_path, lost):
    turning = "def turn():\n    try:\n        time.sleep(60)\n    except KeyboardInterrupt as error:\n"
    turning += f"        raise {lost}\n"
    program = PROGRAM.replace("time.sleep(60)", "turn()").replace("@contextmanager", f"{turning}@contextmanager")
    code, error = stopped(clip, tmp_path, signal.SIGHUP, program=program)
    assert (code, error) == (129, "dddas: ended by SIGHUP; results up to here are kept\n")
    assert (record(tmp_path / "out")["state"], record(tmp_path / "out")["frames"]["written"]) == ("interrupted", 3)
    assert (tmp_path / "out" / "tracks.txt").exists()


def test_a_signal_is_found_behind_the_exception_of_a_library_and_not_behind_bad_input():
    def behind(error):
        try:
            try:
                raise Stopped(signal.SIGTERM)
            except KeyboardInterrupt:
                raise error  # noqa: B904 (libraries say no more)
        except Exception as raised:
            return is_stop(raised)

    assert is_stop(Stopped(signal.SIGTERM)) and behind(RuntimeError()) and behind(OSError())
    assert not behind(InputError("cannot write")) and not is_stop(RuntimeError()) and not is_stop(None)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
@pytest.mark.parametrize("times", [1, 2])
@pytest.mark.parametrize("line", ["detect {clip} --config fast", "people {clip} --set people.enlarge=4", "evaluate"])
def test_a_signal_ends_each_command_with_whole_outputs(clip, tmp_path, line, number, times):
    out = tmp_path / "out"
    if line == "evaluate":
        words = ["evaluate", "--dataset", str(world.three(tmp_path / "clips")), "--cache", str(tmp_path / "cache")]
        call, sign = [sys.executable, "-c", MAIN, *words, "--jobs", "1"], "1 of 3"
    else:
        program = PROGRAM.replace('print("now", flush=True)', 'print("now", file=sys.stderr, flush=True)')
        words = [*shlex.split(line.format(clip=clip)), "--quiet"]
        call, sign = [sys.executable, "-c", f"import sys\n{program}", *words], "now"
    call += ["--out", str(out)]
    with subprocess.Popen(call, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stderr is not None
        assert any(sign in said for said in process.stderr)
        for _ in range(times):
            process.send_signal(number)
        error = process.communicate(timeout=120)[1]
    assert process.returncode == 128 + number, error
    said = "interrupted" if number == signal.SIGINT else f"ended by {number.name}"
    assert " kept" in error and error.startswith(f"dddas: {said}") and error.count("\n") == 1
    assert json.loads((out / "run.json").read_text())["state"] == "interrupted"
    assert not [path for path in out.rglob("*") if path.name.startswith(".") or ".part" in path.name]
    if line != "evaluate":
        assert record(out)["frames"]["written"] == 3
        assert cv2.VideoCapture(str(out / "overlay.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 3


@pytest.mark.skipif(sys.platform != "linux", reason="asks the system which signals are handled")
def test_a_second_signal_after_python_has_ended_changes_no_exit_code(clip, tmp_path):
    # The library of C runs this once Python is gone, and waits for the end of the input.
    late = "import ctypes\nlibrary = ctypes.CDLL(None)\nlibrary.__cxa_atexit(library.getchar, None, None)\n"
    (tmp_path / "det.txt").write_text(TABLE)
    words = ["track", clip, "--detections", tmp_path / "det.txt", "--out", tmp_path / "out", "--quiet"]
    call = [sys.executable, "-c", late + PROGRAM, *map(str, words)]
    pipe = subprocess.PIPE
    with subprocess.Popen(call, cwd=ROOT, stdin=pipe, stdout=pipe, stderr=pipe, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "now\n"
        process.send_signal(signal.SIGTERM)
        until = time.monotonic() + 60
        while _handles(process.pid, signal.SIGHUP) and time.monotonic() < until:
            time.sleep(0.01)
        process.send_signal(signal.SIGHUP)
        _, error = process.communicate(timeout=60)
    assert (process.returncode, error) == KEPT


BEGUN = """
    import os
    from torchvision_dddas import cli

    def begin():
        try:
            os.kill(os.getpid(), {})
        except KeyboardInterrupt:  # as while a library is loaded, which makes another error of it
            {}

    cli.app.registered_callback.callback = begin
    cli.main()
"""
LOADING = """
    import os, sys
    from torchvision_dddas.cli import main

    class Loading:
        def find_spec(self, name, *_):
            if name == "typer":
                os.kill(os.getpid(), {})

    sys.meta_path.insert(0, Loading())
    main()
"""


@pytest.mark.parametrize("lost", ["raise", "raise ImportError('initialization failed') from None", None])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_before_the_command_begins_or_while_it_is_loaded_is_one_line(number, lost):
    result = run_program((BEGUN if lost else LOADING).format(int(number), lost), "settings")
    name = "interrupted" if number == signal.SIGINT else f"ended by {number.name}"
    assert (result.returncode, result.stderr) == (128 + number, f"dddas: {name}; nothing was kept\n")


def test_a_signal_after_the_command_has_ended_is_one_line():
    late = """
        import os, signal
        from torchvision_dddas.cli import commands, main

        def close(output, code):
            os.kill(os.getpid(), signal.SIGTERM)

        commands.close_output = close
        main()
    """
    result = run_program(late, "settings")
    assert (result.returncode, result.stderr) == KEPT


def _handles(process, number):
    (caught,) = (line for line in Path(f"/proc/{process}/status").read_text().splitlines() if line[:7] == "SigCgt:")
    return bool(int(caught.split()[1], 16) >> (number - 1) & 1)


def test_a_signal_that_is_ignored_takes_no_other_with_it():
    def both():
        with uninterrupted():
            os.kill(os.getpid(), signal.SIGHUP)
            os.kill(os.getpid(), signal.SIGTERM)

    before = [signal.signal(signal.SIGHUP, signal.SIG_IGN), signal.getsignal(signal.SIGTERM)]
    try:
        with raising_signals(lambda *_: None):
            with pytest.raises(Stopped) as stop:
                both()
            assert stop.value.number == signal.SIGTERM
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before[0])
        signal.signal(signal.SIGTERM, before[1])


def test_a_signal_at_any_step_of_the_handling_of_another_one_does_not_hang():
    together = """
        import os, signal, sys
        from torchvision_dddas.io.interrupts import Stopped, raising_signals, uninterrupted

        def trace(frame, event, argument):
            global left
            left -= 1
            if left == 0:
                os.kill(os.getpid(), signal.SIGTERM)
            return trace

        def send():
            sys.settrace(trace)
            os.kill(os.getpid(), signal.SIGINT)

        def send_held():
            with uninterrupted():
                send()

        for act in (send, send_held):
            for left in range(1, 40):
                with raising_signals(lambda *_: None):
                    try:
                        act()
                        raise SystemExit("no signal came")
                    except Stopped:
                        sys.settrace(None)
    """
    result = run_program(together)
    assert (result.returncode, result.stderr) == (0, "")


def test_a_main_thread_that_no_signal_reaches_does_not_hold_up_whole_outputs(clip, tmp_path):
    # A mutex of C that is locked twice waits on after a signal, as a library's loop does.
    deafly = "library, mutex = ctypes.CDLL(None), ctypes.create_string_buffer(64)"
    deafly += "; [library.pthread_mutex_lock(mutex) for _ in range(2)]"
    deaf = PROGRAM.replace("import time", "import ctypes, time").replace("time.sleep(60)", deafly)
    assert stopped(clip, tmp_path, signal.SIGTERM, program=deaf) == KEPT
    assert record(tmp_path / "out")["state"] == "interrupted"
    assert not [path for path in (tmp_path / "out").iterdir() if path.name.startswith(".")]


def test_a_signal_while_whole_outputs_are_closed_leaves_them_and_says_so(clip, tmp_path):
    closing = "from torchvision_dddas.io.output.run_record import RunRecord\nclose = RunRecord.close\n"
    closing += "def slow(*words):\n    print('now', flush=True)\n    time.sleep(3)\n    close(*words)\n"
    closing += "RunRecord.close = slow\n"
    program = PROGRAM.replace("count == 3", "False").replace("progress.progress", closing + "progress.progress", 1)
    assert stopped(clip, tmp_path, signal.SIGTERM, program=program) == KEPT
    assert (record(tmp_path / "out")["state"], record(tmp_path / "out")["frames"]["written"]) == ("complete", 5)


def test_a_second_run_into_the_same_folder_is_refused_in_one_line(clip, tmp_path, dddas):
    with tracking(clip, tmp_path, "--quiet"):
        assert "another run is writing into" in bad(dddas("detect", clip, "--out", tmp_path / "out"))
    result = dddas("track", clip, "--detections", tmp_path / "det.txt", "--out", tmp_path / "out")  # it was killed
    assert result.exit_code == 0, result.stderr
    assert not [path for path in (tmp_path / "out").iterdir() if path.name.startswith(".")]


def run_main(*words, **options):
    call = [sys.executable, "-c", MAIN, *map(str, words)]
    return subprocess.run(call, cwd=ROOT, stderr=subprocess.PIPE, text=True, timeout=120, **options)


def test_nothing_was_kept_is_said_where_nothing_was(clip, tmp_path):
    early = PROGRAM.replace("count == 3", "False").replace(
        "def stopping(*_):", "def stopping(*_):\n    print('now', flush=True)\n    time.sleep(60)"
    )
    code, error = stopped(clip, tmp_path, signal.SIGTERM, program=early)
    assert (code, error) == (143, "dddas: ended by SIGTERM; nothing was kept\n")
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_or_closed_standard_output_is_one_line_and_costs_no_result(clip, tmp_path):
    (tmp_path / "det.txt").write_text(TABLE)
    words = ("track", clip, "--detections", tmp_path / "det.txt", "--out", tmp_path / "out")
    with open("/dev/full", "w") as full:  # noqa: PTH123
        result = run_main(*words, stdout=full)
    lines = [line for line in result.stderr.splitlines() if line.startswith("dddas: ")]
    assert (result.returncode, len(lines)) == (74, 1)
    assert "standard output cannot be written: No space left on device" in lines[0]
    assert record(tmp_path / "out")["state"] == "complete"
    closed = subprocess.Popen(["true"], stdin=subprocess.PIPE)
    closed.wait(60)
    result = run_main("settings", stdout=closed.stdin)
    assert result.returncode == 74 and result.stderr.count("\n") == 1
    assert "Broken pipe" in result.stderr


@pytest.mark.skipif(sys.platform == "win32", reason="closes streams by a shell")
@pytest.mark.parametrize(("closed", "code"), [("2>&-", 0), ("<&- 2>&-", 0), ("<&- >&- 2>&-", 74)])
def test_closed_streams_cost_no_result(clip, tmp_path, closed, code):
    (tmp_path / "det.txt").write_text(TABLE)
    words = ["track", clip, "--detections", tmp_path / "det.txt", "--out", tmp_path / "out"]
    line = shlex.join([sys.executable, "-c", MAIN, *map(str, words)])
    result = subprocess.run(["sh", "-c", f"{line} {closed}"], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert (result.returncode, record(tmp_path / "out")["state"]) == (code, "complete")
    assert ("tracks.csv" in result.stdout) == (code == 0)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_standard_output_does_not_hide_that_nothing_was_located(tmp_path):
    (tmp_path / "t.csv").write_text("frame,x_px,y_px,width_px,height_px,cut\n1,600,700,150,260,1\n")
    (tmp_path / "c.toml").write_text("focal_px = 1000\nwidth_px = 1280\nheight_px = 960\nheight_m = 1.2\n")
    words = ("locate", "ground", tmp_path / "t.csv", "--camera", tmp_path / "c.toml", "--out", tmp_path / "out")
    with open("/dev/full", "w") as full:  # noqa: PTH123
        result = run_main(*words, stdout=full)
    located, printed = result.stderr.splitlines()
    assert result.returncode == 3
    assert located.startswith("dddas: 0 located, because") and "output cannot be written" in printed


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="other systems take no such names")
@pytest.mark.parametrize("env", [{}, {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}])
@pytest.mark.parametrize("name", [b"cl\xffip", "für".encode()])
def test_names_that_are_no_utf8_or_no_ascii_are_read_and_written(tmp_path, name, env):
    folder = os.fsencode(tmp_path) + b"/" + name
    os.mkdir(folder)  # noqa: PTH102
    writer = cv2.VideoWriter(str(tmp_path / "clip.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10, (64, 48))
    for k in range(5):
        writer.write(np.full((48, 64, 3), 40 * k, np.uint8))
    writer.release()
    os.rename(tmp_path / "clip.mp4", folder + b"/" + name + b".mp4")  # noqa: PTH104
    call = [sys.executable, "-c", MAIN, "detect", folder + b"/" + name + b".mp4", "--out", folder + b"/out"]
    result = subprocess.run(call, cwd=ROOT, env={**os.environ, **env}, capture_output=True, timeout=120)
    assert result.returncode == 0, result.stderr
    found = json.loads(Path(os.fsdecode(folder + b"/out/run.json")).read_text())
    assert found["state"] == "complete" and found["frames"]["written"] == 5
    assert found["input"].endswith(r"cl\xffip.mp4" if b"\xff" in name else "für.mp4")
    assert os.path.exists(folder + b"/out/overlay.mp4")  # noqa: PTH110


@pytest.mark.slow
@pytest.mark.parametrize("stalls", [True, False])
def test_a_network_clip_that_stops_early_is_interrupted_and_its_password_is_shown_nowhere(
    tmp_path, dddas, monkeypatch, capfd, stalls
):
    monkeypatch.setattr("torchvision_dddas.io.sources.STALL_S", 2.0)
    av, rng = pytest.importorskip("av"), np.random.default_rng(1)
    with av.open(str(tmp_path / "clip.mp4"), "w", options={"movflags": "faststart"}) as film:
        stream = film.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for _ in range(40):
            noise = rng.integers(0, 255, (48, 64, 3), dtype=np.uint8)
            film.mux(stream.encode(av.VideoFrame.from_ndarray(noise, format="bgr24")))
        film.mux(stream.encode(None))
    content, over = (tmp_path / "clip.mp4").read_bytes(), Event()

    class Stalling(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content[: len(content) * 4 // 5])
            over.wait(60 if stalls else 0)

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Stalling)
    server.daemon_threads = True
    Thread(target=server.serve_forever, daemon=True).start()
    address = f"http://me:hush1@127.0.0.1:{server.server_address[1]}/clip.mp4?password=hush2"
    result = dddas("detect", address, "--out", tmp_path / "out", "--config", "fast")
    over.set()
    server.shutdown()
    server.server_close()
    assert result.exit_code == 2
    assert "; results up to here are kept" in result.stderr and "Traceback" not in result.output
    found = record(tmp_path / "out")
    assert found["state"] == "interrupted" and 0 < found["frames"]["written"] < 40
    shown = result.output + result.stderr + "".join(capfd.readouterr())
    shown += "".join(path.read_text(errors="ignore") for path in (tmp_path / "out").iterdir() if path.is_file())
    assert "hush" not in shown and "Stream timeout" not in shown
