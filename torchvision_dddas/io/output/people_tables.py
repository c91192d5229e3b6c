"""The people as tables: MOTChallenge text for other tools, and CSV with named columns, the feet among them."""

from pathlib import Path

from torchvision_dddas.io.tables import MOT, TextFiles, mot_rows
from torchvision_dddas.types import PeopleFrame

COLUMNS = (
    *("frame", "target", "x_px", "y_px", "width_px", "height_px", "score", "kind"),
    *("margin", "feet_u_px", "feet_v_px", "cut"),
)


def mot_lines(recognized: PeopleFrame) -> str:
    """`frame,-1,x,y,width,height,probability,-1,-1,-1`, a line a person: frames from 1, pixels from 0."""
    return MOT.format_rows(mot_rows(recognized.frame.number, recognized.people.box_px, recognized.people.score))


def csv_lines(recognized: PeopleFrame) -> str:
    """One line a person, in the order of COLUMNS.

    The box is the body's. margin: the classifier's own score. feet_u_px, feet_v_px: the point between the feet, from
    the first pixel's centre. cut: 1 where the picture's border cuts the body, so that its height is not to be trusted.
    """
    p = recognized.people
    lines = []
    for i, ((x, y, w, h), (u, v)) in enumerate(zip(p.box_px.tolist(), p.feet_px.tolist(), strict=True)):
        box = f"{x:.2f},{y:.2f},{w:.2f},{h:.2f},{p.score[i]:.4f},person"
        lines.append(f"{recognized.frame.number},{i + 1},{box},{p.margin[i]:.4f},{u:.2f},{v:.2f},{int(p.cut[i])}\n")
    return "".join(lines)


class PeopleTables:
    """detections.txt and detections.csv, written as the clip goes by."""

    def __init__(self, folder: Path) -> None:
        self._files = TextFiles({folder / "detections.txt": "", folder / "detections.csv": ",".join(COLUMNS) + "\n"})

    def write(self, recognized: PeopleFrame) -> None:
        """Add the people of a frame."""
        self._files.write(mot_lines(recognized), csv_lines(recognized))

    def close(self, complete: bool) -> None:
        """Put the tables in their places. Raises OSError if the last lines cannot be written."""
        self._files.close()

    def discard(self) -> None:
        """Remove what was begun."""
        self._files.discard()
