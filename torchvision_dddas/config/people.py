"""Parameters of the person detector."""

from typing import Literal

from pydantic import model_validator

from torchvision_dddas.config.group import Group, parameter


class PeopleParameters(Group):
    """Detection of people by HOG and a linear SVM (appendix A, III-B): descriptor, pyramid, suppression and search."""

    classifier: str = parameter("opencv", "opencv: OpenCV's default people detector; or a file with a linear SVM")
    graphs: str = parameter("shipped", "onboard: shipped, or a folder of ONNX graphs made by `dddas export`")
    window_width_px: int = parameter(64, "width of the classifier's window", "px", 8, 1024)
    window_height_px: int = parameter(128, "height of the classifier's window", "px", 8, 1024)
    cell_px: int = parameter(8, "side of a cell; each cell has one histogram", "px", 2, 64)
    block_px: int = parameter(16, "side of a block of cells; each block is normalised", "px", 2, 256)
    block_stride_px: int = parameter(8, "distance between blocks in a window", "px", 1, 256)
    window_stride_px: int = parameter(8, "distance between windows in each pyramid level", "px", 1, 256)
    bins: int = parameter(9, "orientation bins of a histogram, over 180 degrees, or 360 if signed", "bins", 2, 36)
    signed: bool = parameter(False, "distinguish a gradient from its opposite")
    clip: float = parameter(0.2, "largest share of a block's norm that one element may have (L2-Hys)", "-", 0.01, 1)
    gamma: bool = parameter(True, "take the square root of the grey levels first")
    scale_step: float = parameter(1.05, "ratio of the sizes of successive pyramid levels", "-", 1.01, 2)
    enlarge: float = parameter(
        1.5,
        "scale of the first pyramid level; at 1.5 bodies are found from 64 px; the cost grows with its square",
        "-",
        1,
        4,
    )
    max_levels: int = parameter(64, "largest number of pyramid levels", "levels", 1, 200)
    padding_px: int = parameter(24, "reflected border of each level, to detect people at the border", "px", 0, 256)
    threshold: float = parameter(0.0, "smallest score of a window that may be a person", "-", -10, 10)
    suppression: Literal["nms", "opencv", "none"] = parameter(
        "nms", "nms keeps the best of overlapping windows; opencv averages groups; none keeps all"
    )
    overlap: float = parameter(0.4, "nms: bodies with a larger intersection over union are the same person", "-", 0, 1)
    contained: float = parameter(
        0.7, "nms: bodies that share a larger part of the smaller body are also the same person; 1: off", "-", 0, 1
    )
    settle: float = parameter(
        0.75, "nms: a box is the mean of the windows with at least this intersection over union", "-", 0, 1
    )
    group: int = parameter(2, "opencv: groups of at most this many windows are dropped", "windows", 0, 100)
    group_distance: float = parameter(0.2, "opencv: edges within this distance, in box sizes, form a group", "-", 0, 1)
    height_share: float = parameter(0.738, "body height divided by window height", "-", 0.1, 1)
    width_share: float = parameter(0.5, "body width divided by window width", "-", 0.1, 1)
    feet_share: float = parameter(0.845, "distance from window top to feet, divided by window height", "-", 0.1, 1.2)
    probability_slope: float = parameter(2.6, "probability = 1 / (1 + exp(-slope (score - even)))", "-", 0.01, 100)
    probability_even: float = parameter(0.8, "score at which the probability of a person is 0.5", "-", -10, 10)
    search: Literal["everywhere", "regions"] = parameter(
        "everywhere", "search the whole picture, or regions where people are expected and the rest in turns"
    )
    rescan_frames: int = parameter(
        10,
        "regions: frames over which a search of the whole picture is spread, some levels in each",
        "frames",
        1,
        10_000,
    )
    look_share: float = parameter(
        1.0,
        "regions: largest cost of a frame, as a share of the whole search; 1: no limit (--live: at most 0.1)",
        "-",
        0.001,
        1,
    )
    region_margin: float = parameter(0.2, "regions: margin around an expected body", "heights", 0, 5)
    region_scales: float = parameter(1.15, "regions: a body may be larger or smaller by this factor", "-", 1, 4)

    @model_validator(mode="after")
    def _cells_fill_blocks_and_blocks_the_window(self) -> "PeopleParameters":
        if self.block_px % self.cell_px:
            raise ValueError(f"block_px = {self.block_px} is not a multiple of cell_px = {self.cell_px}")
        for name in ("window_width_px", "window_height_px"):
            more = getattr(self, name) - self.block_px
            if more < 0 or more % self.block_stride_px:
                raise ValueError(
                    f"blocks of block_px = {self.block_px} every block_stride_px = {self.block_stride_px} do not fill "
                    f"{name} = {getattr(self, name)}; wanted {self.block_px} + a multiple of {self.block_stride_px}"
                )
        return self

    @property
    def blocks(self) -> tuple[int, int]:
        """Number of blocks of a window, (across, down)."""
        across, down = (
            (side - self.block_px) // self.block_stride_px + 1 for side in (self.window_width_px, self.window_height_px)
        )
        return across, down

    @property
    def features(self) -> int:
        """Length of the descriptor of one window."""
        across, down = self.blocks
        return across * down * (self.block_px // self.cell_px) ** 2 * self.bins

    @property
    def descriptor(self) -> dict[str, object]:
        """The layout of the descriptor with the keys of classifier files; lengths in px, window as (width, height)."""
        return {
            "window": (self.window_width_px, self.window_height_px),
            "cell": self.cell_px,
            "block": self.block_px,
            "stride": self.block_stride_px,
            "bins": self.bins,
            "signed": self.signed,
            "clip": self.clip,
            "gamma": self.gamma,
        }
