"""Colours: told apart by those who do not see them all."""

from __future__ import annotations

import numpy as np
import pytest

from caryatid.sensing.views import SUPPORT_LABEL
from caryatid.viz.colours import PALETTE, object_colour, object_stripes, rgb

VISIONS = {
    "full": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "tritanopia": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}
"""What the colour-blind see of linear RGB, Machado, Oliveira and Fernandes 2009, severity 1."""
XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
WHITE = np.array([0.95047, 1.0, 1.08883])


def differences(colours, vision):
    """CIE 1976 ΔE of each pair (N, N) of `#rrggbb` colours as they look to somebody; 2.3 are just seen."""
    share = np.array([rgb(c) for c in colours]) / 255.0
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    t = np.clip(linear @ VISIONS[vision].T, 0.0, 1.0) @ XYZ.T / WHITE
    f = np.where(t > (6 / 29) ** 3, np.cbrt(t), t / (3 * (6 / 29) ** 2) + 4 / 29)
    lab = np.stack([116 * f[:, 1], 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], axis=-1)
    return np.linalg.norm(lab[:, None] - lab[None], axis=-1)


@pytest.mark.parametrize("vision", VISIONS)
def test_colours_are_distinguishable_or_have_other_stripes(vision):
    """ΔE ≥ 30 between objects numbered one after the other, ≥ 16 between any two with the same stripes."""
    labels = range(1, len(PALETTE) + 1)
    apart = differences([object_colour(k) for k in labels], vision)
    assert np.diag(apart, 1).min() >= 30.0
    alike = np.array([[object_stripes(a) == object_stripes(b) for b in labels] for a in labels])
    assert apart[alike & ~np.eye(len(alike), dtype=bool)].min() >= 16.0


def test_28_objects_differ_in_colour_or_stripes():
    looks = [(object_colour(k), object_stripes(k)) for k in range(1, 2 * len(PALETTE) + 1)]
    assert len(set(looks)) == len(looks)
    assert object_stripes(1) == object_stripes(SUPPORT_LABEL) == ()
