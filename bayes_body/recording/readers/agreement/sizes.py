"""Pictures of another size than those of the calibration: turned by 90°, or scaled. The changes that may explain it are named, and none is made."""

from collections.abc import Mapping
from typing import NamedTuple

from bayes_body.base.errors import InputError, input_error
from bayes_body.recording.readers.agreement.changes import ANGLES, Size
from bayes_body.recording.readers.agreement.option import SCALED, option
from bayes_body.recording.readers.sources import is_scaled

TURNS = {f"turned_{90 * quarters}": angle for quarters, angle in ANGLES.items() if quarters % 2}


class OtherSize(NamedTuple):
    """A recording: its name, the size of its pictures, and that of the pictures of the camera's calibration."""

    name: str
    size_px: Size
    calibrated_px: Size


class OtherSizesError(InputError):
    """Raised if changes of the calibration would explain the sizes of the pictures.

    Attributes:
        proposals: alternatives of such changes, by camera; under an empty name for all cameras.
    """

    def __init__(self, sizes: Mapping[str, OtherSize], proposals: list[dict[str, str]], best: dict[str, str] | None = None):
        self.sizes, self.proposals = sizes, proposals
        super().__init__(str(_describe(sizes, proposals, best)))

    def with_best(self, best: dict[str, str]) -> "OtherSizesError":
        """Return the error that names the change by which the rays of the keypoints meet."""
        return OtherSizesError(self.sizes, self.proposals, best)


def check_sizes(unfit: Mapping[str, OtherSize], cameras: int) -> None:
    """Refuse sizes that do not fit, if changes would explain all of them.

    Args:
        unfit: by camera, those that do not fit.
        cameras: the number of all cameras.

    Raises:
        OtherSizesError: naming the changes.
    """
    exchanged = [name for name, sizes in unfit.items() if sizes.size_px == sizes.calibrated_px[::-1]]
    resized = [name for name, sizes in unfit.items() if name not in exchanged and is_scaled(sizes.calibrated_px, sizes.size_px)]
    if not unfit or len(exchanged) + len(resized) < len(unfit):
        return
    alternatives = [dict.fromkeys(exchanged, turn) | dict.fromkeys(resized, SCALED) for turn in (TURNS if exchanged else (SCALED,))]
    # One change of all cameras is shorter.
    is_common = len(unfit) == cameras and not (exchanged and resized)
    raise OtherSizesError(unfit, [{"": next(iter(changes.values()))} if is_common else changes for changes in alternatives])


def _describe(sizes: Mapping[str, OtherSize], proposals: list[dict[str, str]], best: dict[str, str] | None) -> InputError:
    first = next(iter(sizes.values()))
    (width, height), (calibrated_width, calibrated_height) = first.size_px, first.calibrated_px
    more = f" (and {len(sizes) - 1} more)" if len(sizes) > 1 else ""
    owners = f"camera{'s' if len(sizes) > 1 else ''} {', '.join(map(repr, sizes))}"
    expected = f"{calibrated_width} x {calibrated_height}, as in its calibration"
    return input_error(owners, f"{first.name}{more} {'have' if more else 'has'} {width} x {height} pixels", expected, _remedy(first, proposals, best))


def _remedy(sizes: OtherSize, proposals: list[dict[str, str]], best: dict[str, str] | None) -> str:
    if sizes.size_px != sizes.calibrated_px[::-1]:
        factor = sizes.size_px[0] / sizes.calibrated_px[0]
        exact = {0.5: "half the", 2.0: "twice the"}.get(factor, f"{factor:.3g} times the")
        return f"the pictures have exactly {exact} size: if they show the same scene, scale the calibration by {option(proposals[0])}"
    turned = "the sides are exchanged, as in pictures that were turned by 90°"
    if best is not None:
        angle = next(TURNS[change] for change in best.values() if change in TURNS)
        return f"{turned}: the rays of the keypoints meet if they were turned by {angle}: import again with {option(best)}"
    choices = " or ".join(f"{option(changes)} ({angle})" for changes, angle in zip(proposals, TURNS.values(), strict=True))
    return f"{turned}: turn the calibration with them by {choices}"
