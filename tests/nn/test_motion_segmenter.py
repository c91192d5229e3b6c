"""Motion segmentation: the torch engine's results without softness, gradients with it."""

from itertools import pairwise

import numpy as np
import pytest
import torch

from tests.synthetic_clip import render
from torchvision_dddas.config import EVIDENCE_SCALE, Settings, load_config, with_parameters
from torchvision_dddas.detection import MotionDetector, Window, detect_masks
from torchvision_dddas.detection.interval import choose_pairs
from torchvision_dddas.detection.torch_engine import TorchEngine
from torchvision_dddas.errors import InputError
from torchvision_dddas.functional import soft
from torchvision_dddas.nn import Core, Differences, FrameRegistration, MotionSegmenter, Regions
from torchvision_dddas.nn.motion_segmenter import TUNED, chain_motion

KNOBS: dict[str, float] = {
    "difference.noise_levels": 4.0,
    "difference.gradient_share": 0.15,
    "difference.threshold": 4.0,
    "difference.blur_px": 5,
    "morphology.erode_px": 2,
    "morphology.close_px": 7,
    "difference.peak": 5.0,
    "gates.min_area_px": 20,
}
SETTINGS = with_parameters(Settings(), KNOBS)
# Where noise is the unit, nothing is many units above it.
NOISY = with_parameters(SETTINGS, {"difference.threshold": 1.5, "difference.peak": 1.6})


def differences(
    dtype: torch.dtype = torch.float32, noisy: bool = False, height: int = 24, width: int = 32
) -> Differences:
    """One window with two pairs: two bright squares on noise; noisy: so much of it that it sets the unit."""
    random = torch.Generator().manual_seed(5)
    level = 60 if noisy else 6
    least = torch.randint(0, level, (2, 2, height, width), generator=random)
    least[0, :, 5:13, 6:15] += 100
    least[1, :, 14:20, 20:28] += 80
    texture = torch.randint(0, 60, (2, 1, height, width), generator=random)
    both = torch.ones(2, 2, height, width, dtype=torch.bool)
    both[..., :2] = False
    return Differences(least.to(torch.uint8), both, texture.to(dtype), torch.full_like(texture, 90).to(torch.uint8))


def values() -> dict[str, torch.Tensor]:
    return {name: torch.tensor(value, dtype=torch.float64) for name, value in KNOBS.items()}


@pytest.mark.parametrize("noisy", [False, True])
def test_a_soft_core_tends_to_the_hard_one_as_softness_vanishes(noisy: bool) -> None:
    motion, windows = MotionSegmenter(NOISY if noisy else SETTINGS, tuned=()), differences(noisy=noisy)
    hard = motion.segment(windows, values={}).mask
    assert 0 < float(hard.mean()) < 1 and set(hard.unique().tolist()) == {0.0, 1.0}
    misses = [
        float((motion.segment(windows, values={}, softness=softness).mask - hard).abs().mean())
        for softness in (0.5, 0.1, 0.02, 0.004)
    ]
    assert misses[0] > misses[1] > misses[2] > misses[3] and misses[3] < 0.01


@pytest.mark.parametrize("kind", ["normalized", "to_reference"])
def test_parameters_as_tensors_give_what_the_settings_give(kind: str) -> None:
    settings = with_parameters(SETTINGS, {"difference.kind": kind})
    motion, windows = MotionSegmenter(settings, tuned=()), differences()
    given, tuned = (
        motion.segment(windows, values={}, softness=0.1),
        motion.segment(windows, values=values(), softness=0.1),
    )
    torch.testing.assert_close(given.mask, tuned.mask)
    torch.testing.assert_close(given.evidence, tuned.evidence)


@pytest.mark.parametrize("noisy", [False, True])
def test_the_gradient_of_every_parameter_of_the_core_is_right(noisy: bool) -> None:
    """In double precision, between whole sizes, and where nothing is rounded."""
    windows = differences(torch.float64, noisy)
    motion = MotionSegmenter(NOISY if noisy else SETTINGS, whole=False, tuned=())
    names = [name for name in KNOBS if name not in ("difference.peak", "gates.min_area_px")]
    at = (4.1, 0.16, 1.6 if noisy else 3.9, 4.3, 2.4, 5.6)
    weight = torch.rand(2, 1, 24, 32, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def total(*parameters: torch.Tensor) -> torch.Tensor:
        return (
            motion.segment(windows, values=dict(zip(names, parameters, strict=True)), softness=0.2).mask * weight
        ).sum()

    starts = tuple(torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in at)
    # The unit of noise has whole steps and so has jumps; small steps stay between them.
    assert torch.autograd.gradcheck(total, starts, eps=1e-7, atol=2e-3, rtol=2e-3)


def regions(core: Core) -> Regions:
    """The squares of the first picture, and those of the second, as one region each."""
    near = (core.margin > 0).long()
    return Regions(near, near, 1)


@pytest.mark.parametrize(
    ("name", "value", "left"),
    [
        ("gates.min_area_px", 20.0, True),
        ("gates.min_area_px", 400.0, False),
        ("difference.peak", 14.0, True),
        ("difference.peak", 16.0, False),
    ],
)
def test_a_region_below_its_area_or_its_peak_is_gone_and_one_above_both_is_whole(name, value, left) -> None:
    motion = MotionSegmenter(SETTINGS, tuned=())
    core = motion.segment(differences(), values={})
    mask = motion.outlined(core, regions(core), values={name: torch.tensor(value)})
    assert torch.equal(mask, core.mask if left else torch.zeros_like(mask))


def test_a_hole_in_a_hull_is_there_as_far_as_its_region() -> None:
    motion, windows = MotionSegmenter(SETTINGS, tuned=()), differences()
    core = motion.segment(windows, values={})
    near = regions(core).near
    filled = near.clone()
    filled[0, 0, 0, 5] = 1
    found = Regions(near, filled, 1)
    assert float(motion.outlined(core, found, values={})[0, 0, 0, 5]) == 1.0
    area = torch.tensor(300.0, dtype=torch.float64, requires_grad=True)
    soft = motion.outlined(
        motion.segment(windows, values={}, softness=0.1), found, values={"gates.min_area_px": area}, softness=0.3
    )[0, 0, 0, 5]
    (slope,) = torch.autograd.grad(soft, area)
    assert 0 < float(soft.detach()) < 1 and float(slope) < 0


def test_windows_that_show_nothing_give_nothing_and_no_nan() -> None:
    none = torch.zeros(1, 1, 20, 20)
    parameters = {name: value.requires_grad_() for name, value in values().items()}
    motion = MotionSegmenter(SETTINGS, tuned=())
    core = motion.segment(Differences(none.byte(), none.bool(), none, none.byte()), values=parameters, softness=0.1)
    mask = motion.outlined(core, Regions(none.long(), none.long(), 0), values=parameters, softness=0.1)
    mask.sum().backward()
    assert not mask.any() and all(v.grad is None or bool(v.grad.isfinite()) for v in parameters.values())


def test_a_smoothed_silhouette_has_hard_masks_only() -> None:
    settings = with_parameters(SETTINGS, {"difference.blur_of": "silhouette", "morphology.dilate_px": 3})
    assert MotionSegmenter(settings, tuned=()).segment(differences()).mask.any()
    with pytest.raises(InputError, match="blur_of=difference"):
        MotionSegmenter(settings, softness=0.1).segment(differences())


FRAMES, SIZE = 7, (160, 120)
GAIN = [1.0, 1.0, 1.2, 1.0, 0.8, 1.0, 1.0]
KINDS = ["normalized", "to_reference", "between_later", "to_next"]


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    """Colour frames of a moving camera whose exposure jumps."""
    return render(1, FRAMES, SIZE, GAIN).images


@pytest.fixture(scope="module")
def clip(images) -> torch.Tensor:
    """(1, T, 3, H, W) RGB in [0, 1]."""
    return torch.from_numpy(np.stack(images)[..., ::-1].copy()).permute(0, 3, 1, 2)[None] / 255.0


def of_kind(kind: str) -> Settings:
    threshold = 3.5 if kind == "normalized" else 20.0
    return with_parameters(Settings(), {"difference.kind": kind, "difference.threshold": threshold})


@pytest.mark.parametrize("kind", KINDS)
def test_of_a_clip_it_finds_bit_for_bit_what_the_torch_engine_does(kind, images, clip) -> None:
    """Two clips at once, the second backwards; the engine is given the same motion."""
    settings = of_kind(kind)
    clips = torch.cat([clip, clip.flip(1)])
    found = MotionSegmenter(settings)(clips)
    engine = TorchEngine(settings, "cpu")
    for number, frames in enumerate((images, images[::-1])):
        views = [engine.prepare(image) for image in frames]
        motion = found.later_from_earlier[number : number + 1]
        for at in range(FRAMES):
            pairs, _, _ = choose_pairs(at, settings.interval.frames, 0, FRAMES - 1, settings)
            used = sorted({frame for pair in pairs for frame in pair})
            matrices = torch.cat([chain_motion(motion, at, other) for other in used]).numpy()
            near = tuple((used.index(a), used.index(b)) for a, b in pairs)
            window = Window(views[at], tuple(views[k] for k in used), matrices, tuple(k - at for k in used), near)
            (wanted,) = engine.foreground([window])
            unit = EVIDENCE_SCALE if kind == "normalized" else 1.0
            np.testing.assert_array_equal(found.mask[number, at, 0].numpy() > 0.5, wanted.core > 0)
            np.testing.assert_array_equal(found.evidence[number, at, 0].numpy() * unit, wanted.evidence)
    assert found.mask.any() and set(found.mask.unique().tolist()) == {0.0, 1.0}


def test_with_the_later_steps_it_is_the_detector_with_the_torch_engine(images, clip) -> None:
    model = MotionSegmenter(with_parameters(Settings(), {"gates.min_area_px": 40}))
    with torch.no_grad():
        model.get_parameter("difference_threshold").mul_(1.2)
    settings = model.tuned_settings()
    assert settings.difference.threshold == pytest.approx(1.2 * Settings().difference.threshold)
    detector = MotionDetector(settings, backend=TorchEngine(settings, "cpu"))
    scenes = [scene for image in images for scene in detector.update(image)] + detector.flush()
    found = detect_masks(model, torch.cat([clip, clip.flip(1)]))
    assert found.shape == (2, FRAMES, 1, *reversed(SIZE)) and found[0].any()
    np.testing.assert_array_equal(found[0, :, 0].numpy(), np.stack([scene.mask > 0 for scene in scenes]))


def test_of_a_clip_it_finds_the_motion_that_the_torch_engine_does(images, clip) -> None:
    engine = TorchEngine(Settings(), "cpu")
    wanted = engine.register(list(pairwise(engine.prepare(image) for image in images)))
    found = MotionSegmenter()(clip)
    assert found.inliers.tolist() == [[step.inliers for step in wanted]]
    for matrix, step in zip(found.later_from_earlier[0].numpy(), wanted, strict=True):
        np.testing.assert_allclose(matrix, step.later_from_earlier, rtol=0, atol=1e-6)


def test_a_loss_on_a_clip_moves_the_parameters_that_are_learned(clip) -> None:
    model = MotionSegmenter(softness=0.2)
    assert set(dict(model.named_parameters())) == {name.replace(".", "_") for name in TUNED}
    before = model(clip).mask.mean()
    before.backward()
    slopes = [parameter.grad for parameter in model.parameters()]
    assert all(slope is not None and slope.isfinite() and slope < 0 for slope in slopes)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.mul_(1.1)
    assert model(clip).mask.mean().item() < before.item()


def test_from_pictures_to_masks_the_gradient_of_every_learned_parameter_is_right() -> None:
    """In double precision and without rounding; the camera stands."""
    random = torch.Generator().manual_seed(3)
    clip = (0.3 + 0.05 * torch.rand(1, 1, 1, 32, 40, generator=random, dtype=torch.float64)).repeat(1, 3, 1, 1, 1)
    for frame in range(3):
        clip[0, frame, 0, 10:20, 6 + 6 * frame : 16 + 6 * frame] += 0.2
    still = torch.eye(3, dtype=torch.float64).expand(1, 2, 3, 3)
    model = MotionSegmenter(with_parameters(Settings(), {"morphology.close_px": 3}), softness=0.2, whole=False)
    weight = torch.rand(1, 3, 1, 32, 40, generator=random, dtype=torch.float64)

    def total(*parameters: torch.Tensor) -> torch.Tensor:
        return (model(clip, still, values=dict(zip(TUNED, parameters, strict=True))).mask * weight).sum()

    starts = tuple(parameter.detach().clone().requires_grad_() for parameter in model.parameters())
    slopes = torch.autograd.grad(total(*starts), starts)
    assert all(slope.abs() > 1e-3 for slope in slopes)
    assert torch.autograd.gradcheck(total, starts, eps=1e-7, atol=2e-3, rtol=2e-3)


def test_the_margin_of_a_clip_is_above_zero_where_the_mask_is_above_one_half_and_has_gradients(clip) -> None:
    model = MotionSegmenter(of_kind("normalized"), softness=0.2)
    found = model(clip)
    assert found.margin.shape == found.mask.shape and 0 < float((found.margin > 0).double().mean()) < 1
    assert torch.equal(found.margin > 0, found.mask > 0.5)
    found.margin.sum().backward()
    assert all(parameter.grad is not None and parameter.grad != 0 for parameter in model.parameters())


def test_frames_without_two_neighbours_show_nothing(clip) -> None:
    found = MotionSegmenter()(clip[:, :2])
    assert found.mask.shape == (1, 2, 1, 120, 160) and not found.mask.any()


@pytest.mark.slow
@pytest.mark.parametrize("asks", [False, True])
@pytest.mark.parametrize("softness", [0.0, 0.2])
@pytest.mark.parametrize("kind", KINDS)
def test_off_the_cpu_nothing_from_pictures_to_masks_asks_for_a_value(kind, softness, asks, clip, monkeypatch) -> None:
    """Tensors on `meta` have none, and meet no others: the first question raises, as branches on a CPU show."""
    model = MotionSegmenter(of_kind(kind), softness=softness).to("meta")
    if asks:
        monkeypatch.setattr(soft, "may_branch", lambda _: True)
        with pytest.raises((RuntimeError, NotImplementedError)):
            model(clip.to("meta"))
    else:
        found = model(clip.to("meta"))
        assert {part.device.type for part in found} == {"meta"}
        assert found.mask.shape == (1, FRAMES, 1, SIZE[1], SIZE[0])


def test_both_ways_of_registration_taken_at_once_give_what_the_branches_give(clip, monkeypatch) -> None:
    """Of pairs whose scouts agree, and of one whose scouts do not."""
    grey = clip[0].mean(1, keepdim=True)
    noise = torch.rand(1, 1, SIZE[1], SIZE[0], generator=torch.Generator().manual_seed(0))
    earlier, later, registration = grey[:-1], torch.cat([grey[1:4], noise, grey[5:]]), FrameRegistration()
    wanted = registration(earlier, later)
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    found = registration(earlier, later)
    assert wanted.inliers.sum(1).min() < 12 < wanted.inliers.sum(1).max()
    assert (found.inliers == wanted.inliers).float().mean() > 0.99
    torch.testing.assert_close(found.later_from_earlier, wanted.later_from_earlier, rtol=0, atol=1e-4)


@pytest.mark.gpu
@pytest.mark.parametrize("kind", KINDS)
def test_on_a_gpu_the_masks_are_those_of_the_cpu_and_nothing_is_read_back(kind, clip) -> None:
    model, there = MotionSegmenter(of_kind(kind)), MotionSegmenter(of_kind(kind)).cuda()
    motion = model(clip).later_from_earlier
    given = clip.cuda(), motion.cuda()
    there(*given)  # kernels are loaded
    with torch.profiler.profile() as profile:
        found = there(*given)
    names = {event.name for event in profile.events()}
    assert not any("DtoH" in name or name in ("aten::item", "aten::nonzero") for name in names)
    assert (found.mask.cpu() != model(clip, motion).mask).float().mean() < 0.002


@pytest.mark.parametrize("kind", KINDS)
def test_without_asking_the_host_as_on_a_gpu_or_in_a_trace_the_results_are_the_same(kind, clip, monkeypatch) -> None:
    model, softened = MotionSegmenter(of_kind(kind)), MotionSegmenter(of_kind(kind), softness=0.2)
    motion = model(clip).later_from_earlier
    wanted = [one(clip, motion) for one in (model, softened)]
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    for one, before in zip((model, softened), wanted, strict=True):
        after = one(clip, motion)
        assert torch.equal(after.mask, before.mask) and torch.equal(after.evidence, before.evidence)


@pytest.mark.parametrize(("batch", "frames"), [(1, 1), (2, 1), (0, 3)])
def test_clips_without_a_step_show_nothing(batch, frames) -> None:
    found = MotionSegmenter()(torch.rand(batch, frames, 3, 48, 64))
    assert found.mask.shape == (batch, frames, 1, 48, 64) and not found.mask.any()
    assert found.later_from_earlier.shape == (batch, frames - 1, 3, 3)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: MotionSegmenter(softness=-1.0), "softness must be 0 or more, got -1"),
        (lambda: MotionSegmenter(tuned=("registration.ransac_px",)), "no parameter registration.ransac_px; wanted"),
        (
            lambda: MotionSegmenter()(torch.rand(2, 3, 48, 64)),
            r"a clip must be floats .*, got torch.float32 \(2, 3, 48",
        ),
        (lambda: MotionSegmenter()(torch.zeros(1, 3, 3, 48, 64, dtype=torch.uint8)), "got torch.uint8"),
        (lambda: MotionSegmenter()(torch.rand(1, 3, 1, 48, 64), torch.eye(3).expand(1, 3, 3, 3)), "one matrix a step"),
        (
            lambda: MotionSegmenter()(torch.rand(1, 3, 1, 48, 64), values={"difference.treshold": 9.0}),
            "treshold; wanted",
        ),
    ],
)
def test_wrong_arguments_are_one_line(make, words) -> None:
    with pytest.raises(InputError, match=words):
        make()


@pytest.mark.slow
def test_the_exported_graph_gives_the_same_masks_for_clips_it_was_not_made_with() -> None:
    runtime = pytest.importorskip("onnxruntime")
    model = MotionSegmenter(load_config("fast")).eval()

    class Masks(torch.nn.Module):
        def forward(self, clip: torch.Tensor, later_from_earlier: torch.Tensor) -> torch.Tensor:
            return model(clip, later_from_earlier).mask

    clips = [np.stack(render(seed, 3, (128, 96)).images) for seed in (0, 1)]
    frames = [torch.from_numpy(clip).permute(0, 3, 1, 2)[None] / 255 for clip in clips]
    step = torch.eye(3, dtype=torch.float64).repeat(1, 2, 1, 1)
    program = torch.onnx.export(Masks(), (frames[0], step), dynamo=True, optimize=False, verbose=False)
    assert program is not None
    session = runtime.InferenceSession(program.model_proto.SerializeToString())
    names = [one.name for one in session.get_inputs()]
    for clip in frames:
        (found,) = session.run(None, dict(zip(names, (clip.numpy(), step.numpy()), strict=True)))
        wanted = model(clip, step).mask
        assert wanted.any() and (found != wanted.numpy()).mean() < 1e-4


@pytest.mark.parametrize(
    ("spoil", "code"),
    [
        (lambda clip: clip.half(), "clip.float()"),
        (lambda clip: clip.bfloat16(), "clip.float()"),
        (lambda clip: (clip * 255).to(torch.uint8), "clip.float() / 255"),
        (lambda clip: clip * 255, "clip / 255"),
        (lambda clip: clip.index_fill(3, torch.tensor([3]), torch.nan), "clip.nan_to_num()"),
        (lambda clip: clip - 0.5, "clip.clamp(0, 1)"),
    ],
    ids=["half", "bfloat16", "bytes", "levels", "NaN", "below 0"],
)
def test_a_clip_of_another_range_or_precision_is_refused_with_the_code_that_converts_it(spoil, code) -> None:
    segmenter, given = MotionSegmenter(), spoil(torch.rand(1, 3, 1, 48, 64))
    with pytest.raises(InputError) as error:
        segmenter(given)
    message = str(error.value)
    assert message.endswith(f"convert it: {code}") and "\n" not in message
    assert segmenter(eval(code, {"clip": given})).mask.shape == (1, 3, 1, 48, 64)
