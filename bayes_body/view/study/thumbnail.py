"""A small picture of a run for the page of its study."""

from pathlib import Path

from bayes_body.base.files.atomic import make_folder, replacing
from bayes_body.results.storage.names import OVERLAY_FOLDER

# Pixels.
WIDTH = 160
QUALITY = 80


def write_thumbnail(run_folder: Path, path: Path) -> bool:
    """Write the first still of a run's overlay, WIDTH pixels wide, as a JPEG. Return whether there is a still that can be read.

    Raises:
        InputError: the file system does not accept it.
    """
    stills = sorted((run_folder / OVERLAY_FOLDER).glob("frame_*.png"))
    if not stills:
        return False
    # The driver of a study that has no pictures need not load OpenCV.
    import cv2

    picture = cv2.imread(str(stills[0]), cv2.IMREAD_REDUCED_COLOR_2)
    if picture is None:
        return False
    height = max(1, round(picture.shape[0] * WIDTH / picture.shape[1]))
    small = cv2.resize(picture, (WIDTH, height), interpolation=cv2.INTER_AREA)
    encoded = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
    make_folder(path.parent)
    with replacing(path) as partial:
        partial.write_bytes(encoded.tobytes())
    return True
