"""What a run says about a likelihood that compares frames: where it is silent, and what in the recording misleads it."""

from bayes_body.base.errors import input_error
from bayes_body.base.progress import watched
from bayes_body.initial import Show
from bayes_body.model.build import Model
from bayes_body.recording.observation.frame_pairs import pair_sentences
from bayes_body.recording.session.session import Session
from bayes_body.view.figures_text import warning_line


def check_pairs(session: Session, model: Model, frames: int, show: Show, bar: bool) -> list[str]:
    """Look at all pairs of frames, if a likelihood compares them. Show and return warnings about them.

    Raises:
        InputError: there is only one frame, and no likelihood that a single frame informs.
    """
    likelihoods, comparing = [factor for factor in model.factors if factor.side == "likelihood"], _comparing(model)
    if not comparing:
        return []
    if frames < 2 and len(comparing) == len(likelihoods):
        expected = f"two or more: {' and '.join(comparing)} compares a frame with the one before"
        raise input_error("frames", "one", expected, "track more frames, or add a likelihood of one frame to the model")
    others = (
        "only the other likelihoods inform it" if len(comparing) < len(likelihoods) else "its posterior is the first pose, spread by the motion prior"
    )
    show(f"{' and '.join(comparing)}: silent in frame {session.first_frame}, which has no frame before it: {others}.")
    sentences = pair_remarks(session, model, frames, bar)
    for sentence in sentences:
        show(warning_line(sentence))
    return sentences


def pair_remarks(session: Session, model: Model, frames: int, bar: bool) -> list[str]:
    """Return warnings about all pairs of frames, if a likelihood compares them."""
    return pair_sentences(session, frames, watched("pairs of frames", bar)) if _comparing(model) else []


def _comparing(model: Model) -> list[str]:
    return [factor.name for factor in model.factors if factor.side == "likelihood" and factor.reads_previous]
