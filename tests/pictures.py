"""Images as volcli writes them, of an optical depth that is given."""

import numpy as np

from volcli import images

RAMP = np.linspace(0, 3, 48 * 32).reshape(32, 48)
"""Optical depths from 0 to 3, of 48 x 32 pixels."""


def write_volcli_exr(path, tau, colour=(0.5, 0.25, 1.0), behind=None, header=None):
    """An EXR as volcli writes it, of an optical depth (h, w)."""
    tau = np.asarray(tau, np.float64)
    opacity, through = -np.expm1(-tau), np.exp(-tau)
    rgba = np.dstack([*(opacity * c for c in colour), opacity])
    if behind is not None:
        rgba = rgba + through[..., None] * np.array([*behind, 1.0])
    channels = {c: rgba[..., i] for i, c in enumerate("RGBA")}
    channels["Z"] = np.where(opacity > 0, 5.0, np.inf)
    channels |= {"transmittance.Y": through, "optical_depth.Y": tau}
    job = "" if behind is None else f"[background]\ncolor = {list(behind)}\n"
    images.write_exr(path, channels, {"volcli:job": job, **(header or {})})
    return path
