"""Which rules are measured: exact, midpoint with several steps, certified with several errors."""

from __future__ import annotations

from dataclasses import dataclass, replace

from volcli.plan import Plan
from volcli.schema import Quadrature

STEPS = (8.0, 4.0, 2.8, 2.0, 1.4, 1.0, 0.7, 0.5, 0.333, 0.25, 0.125)
"""Voxels: of the midpoint rule, closest where most people choose."""

MAX_ERRORS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)
"""Of the certified rule."""


@dataclass(frozen=True)
class Setting:
    """A way to render.

    Attributes
    ----------
    own
        Whether it is what the user's job asks for.
    """

    quadrature: Quadrature
    own: bool = False

    @property
    def family(self) -> str:
        """``exact``, ``midpoint`` or ``certified``."""
        return "certified" if self.quadrature.max_error else self.quadrature.rule

    @property
    def value(self) -> float | None:
        """The step in voxels, or the error that may be made; None of the exact rule."""
        return self.quadrature.max_error or self.quadrature.step_voxels

    @property
    def name(self) -> str:
        """As `Plan.rule`: ``midpoint 0.5``."""
        return self.family if self.value is None else f"{self.family} {self.value:g}"

    def plan(self, plan: Plan) -> Plan:
        """A plan with this rule instead of its own."""
        return replace(
            plan,
            step_voxels=self.quadrature.step_voxels,
            max_error=self.quadrature.max_error or None,
            target_error=None,
        )


def settings(own: Quadrature | None) -> tuple[Setting, ...]:
    """All settings, from exact to the coarsest steps and finest errors.

    Parameters
    ----------
    own
        What the user has chosen, which is measured too; None: nothing.
    """
    wanted = [
        Quadrature(),
        *(Quadrature(rule="midpoint", step=step) for step in STEPS),
        *(Quadrature(max_error=error) for error in MAX_ERRORS),
    ]
    found = {Setting(one).name: Setting(one) for one in wanted}
    if own is not None:
        mine = Setting(own, own=True)
        found[mine.name] = mine
    families = ("exact", "midpoint", "certified")
    return tuple(
        sorted(found.values(), key=lambda one: (families.index(one.family), -(one.value or 0.0)))
    )
