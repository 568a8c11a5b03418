"""What the stated angle of a row space is made of."""

from __future__ import annotations

import numpy as np

from manip_learn.errors import error_in_words, listed
from manip_learn.learning.bootstrap import angle_within_deg, bootstrap_angle_deg
from manip_learn.learning.estimators.estimate import Estimate, check_uncertainty
from manip_learn.learning.evidence.joint_offsets import JointOffsets
from manip_learn.learning.samples import Samples

NOISE, JOINT_ZEROS, POLICY = PARTS = ("noise", "joint zeros", "policy")
# draws of an error whose quantile is stated: uncertain by 5 %
DRAWS = 1000
Uncertainty = dict[str, float | None]


def uncertainty_of(samples: Samples, estimate: Estimate, rng: np.random.Generator) -> Uncertainty:
    """Each part of what the error of a row space stays below in 68 % of cases [deg], by the names in `PARTS`.

    None where a part does not apply: the joints' zeros of any but the null-space estimator, the policy of any but the
    joint one with its parameters integrated out, and all of them with a single trajectory or where there is only one
    possible row space.

    Raises:
        NotIdentifiableError: A joint estimate that is known too badly for an answer.
    """
    whitened, prior = estimate.whitened_selection, estimate.prior
    noise = bootstrap_angle_deg(samples, whitened, estimate.gradients, estimate.hessians, rng, prior=prior)
    if noise is None:
        return dict.fromkeys(PARTS)
    s, r = whitened.shape
    offsets = JointOffsets.of(samples, whitened) if estimate.name == "null-space" else None
    errors = {
        JOINT_ZEROS: None if offsets is None else offsets.errors(DRAWS, rng),
        POLICY: None if prior is None else prior.errors(estimate.hessians, s * (r - s), DRAWS, rng),
    }
    added = {part: None if e is None else angle_within_deg(samples, whitened, e) for part, e in errors.items()}
    parts = {NOISE: noise, **added}
    check_uncertainty(estimate, total_deg(parts))
    return parts


def total_deg(parts: Uncertainty) -> float | None:
    """Root of the sum of the squares of the parts there are [deg]; None if there are none."""
    known = [part for part in parts.values() if part is not None]
    return float(np.linalg.norm(known)) if known else None


def in_words(parts: Uncertainty, reference: str | None) -> str:
    """What a stated angle is made of, and what no recording shows of it: `"noise 0.002 degrees; not included: ..."`.

    Args:
        parts: None of them there where a mechanism's numbers alone are stated, with the joints' zeros among them.
        reference: Of the features; rows in axes of the tool (`"local"`) do not care how the base stands.
    """
    known = [f"{name} {error_in_words(part, 'degrees')}" for name, part in parts.items() if part is not None]
    missing = ["joint zeros that are off"] if known and parts[JOINT_ZEROS] is None else []
    missing += [] if reference == "local" else ["a base that stands turned, which no recording can show"]
    said = ", ".join(known) or "scatter of the samples"
    return f"{said}; not included: {listed(missing)}" if missing else said
