"""A recording of any length, made of the images of a short one."""

import dataclasses
from pathlib import Path

from bayes_body.recording.session.read import save_session
from bayes_body.recording.session.session import Session


def link_looped(session: Session, folder: Path, frames: int) -> Path:
    """A session of so many frames: the images of another to and fro, so that the motion is continuous."""
    to_and_fro = [*range(session.frames), *range(session.frames - 2, 0, -1)]
    views = []
    for number, view in enumerate(session.views):
        (folder / f"view{number}").mkdir(parents=True)
        for frame in range(frames):
            source = to_and_fro[frame % len(to_and_fro)]
            for kind, path in (("image", session.image_path(view, source)), ("mask", session.mask_path(view, source))):
                (folder / f"view{number}" / f"{kind}{frame:06d}{path.suffix}").symlink_to(path)
        names = {kind: f"view{number}/{kind}%06d{path.suffix}" for kind in ("image", "mask")}
        views.append(dataclasses.replace(view, images=names["image"], masks=names["mask"], offset=0))
    save_session(dataclasses.replace(session, folder=folder, frames=frames, first_frame=0, views=tuple(views)))
    return folder
