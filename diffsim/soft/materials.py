"""Materials of the solid, and their constants from Young's modulus and Poisson's ratio.

With F = R S the polar decomposition, s the principal stretches, J = det F, I = |F|^2,
E = (F'F - 1)/2, mu = lame_mu, lambda = lame_lambda, the energy densities psi(F) [J/m^3] are:

* ``"pd"``: projective dynamics, w_mu/2 |F - R|^2 + w_vol/2 |F - B|^2, B the nearest matrix of
  determinant one (thesis eq. 4.12). Needs nu >= 0.
* ``"corotated"``: mu |S - 1|^2 + lambda/2 tr(S - 1)^2. Finite for inverted elements; volume costs
  little where it vanishes.
* ``"stable_neo_hookean"``: m/2 (I - 3) - m/2 ln((I + 1)/4) - mu (J - 1) + l/2 (J - 1)^2 with
  m = 4/3 mu and l = lambda + 5/6 mu (Smith, de Goes, Kim 2018, "Stable Neo-Hookean Flesh
  Simulation", eqs. 13-16, less a constant). Smooth and finite for inverted elements.
* ``"neo_hookean"``: mu/2 (I - 3) - mu ln J + lambda/2 (ln J)^2, infinite where J <= 0: inverted
  elements are refused. For nu < 0 the last term is negative and wins as J -> 0: no barrier.
* ``"mooney_rivlin"``: c1 (I - 3) + c2 (I2 - 3) - 2 (c1 + 2 c2) ln J + (lambda - 4 c2)/2 (ln J)^2
  with I2 = |cof F|^2, c2 = second_share mu/2 and c1 the rest of mu/2; infinite where J <= 0. For
  lambda < 4 c2, which is nu/(1 - 2 nu) < second_share, no barrier as J -> 0.
* ``"stvk"``: St. Venant-Kirchhoff, mu |E|^2 + lambda/2 tr(E)^2. Gives way under strong
  compression (a stretch below 0.58 softens) and does not resist inversion.

All follow linear elasticity at small strain with the constants given (E, nu in = E, nu out), vanish
at rest, and are linear in the element parameters that the kernels read, the *weights*: w_mu = 2 mu
and w_vol = lambda (pd: 3 lambda, see :func:`pd_weights`; mooney_rivlin: three, see
:func:`mooney_rivlin_weights`). How many a law has its kernel states (``kWeights`` in
csrc/kernels/soft); their order here is theirs there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from diffsim.core.check import require_choice, require_range
from diffsim.core.checked import checked
from diffsim.soft.parameters import Value

MATERIALS = ("pd", "corotated", "stable_neo_hookean", "neo_hookean", "mooney_rivlin", "stvk")
NEEDS_POSITIVE_J = ("neo_hookean", "mooney_rivlin")
"""Materials whose energy is infinite where an element is inverted."""
CONSTANTS: Mapping[str, tuple[str, ...]] = {"mooney_rivlin": ("second_share",)}
"""What a law reads besides E and nu: fields of :class:`Material` and names that ``body.physics``
takes, a number or one of each element."""
VOLUME_WEIGHTS = ("small_strain", "thesis")


class LameParameters(NamedTuple):
    """Lame parameters of a linear elastic solid [Pa]."""

    mu: Tensor
    lame_lambda: Tensor


class SolidWeights(NamedTuple):
    """Element parameters of a solid as the kernels read them, (num_elements,) [Pa]."""

    w_mu: Tensor
    w_vol: Tensor


class SmallStrain(NamedTuple):
    """Moduli of an element at small strain, (..., num_elements) [Pa]."""

    two_mu: Tensor
    lame_lambda: Tensor


@dataclass(frozen=True)
class Material:
    """Energy of a solid; a name alone, as in ``SoftBody(material="stvk")``, means the same.

    Attributes:
        law: One of ``MATERIALS``, see this module's docstring.
        volume_weight: Convention for the volume term of ``pd``: ``small_strain`` (E, nu in = E, nu
            out) or ``thesis``, see :func:`pd_weights`.
        second_share: Share of the second invariant in the shear modulus of ``mooney_rivlin``,
            scalar or (num_elements,) [-], in [0, 1]; with 0 it is ``neo_hookean``.
    """

    law: str = "pd"
    volume_weight: str = "small_strain"
    second_share: Value = 0.0

    def __post_init__(self) -> None:
        require_choice("material", self.law, MATERIALS)
        weight = require_choice("volume_weight", self.volume_weight, VOLUME_WEIGHTS)
        if self.law != "pd" and weight != "small_strain":
            raise ValueError(
                f"volume_weight must be 'small_strain' for material={self.law!r}, got "
                f"{weight!r}, a convention of material='pd'"
            )
        is_given = isinstance(self.second_share, Tensor) or self.second_share != 0.0
        if is_given and "second_share" not in self.constants:
            raise ValueError(
                f"second_share is a constant of material='mooney_rivlin', not of {self.law!r}"
            )

    @property
    def constants(self) -> tuple[str, ...]:
        """Names of what the law reads besides E and nu."""
        return CONSTANTS.get(self.law, ())

    @checked
    def weights(
        self, youngs_modulus: Tensor, poissons_ratio: Tensor, **constants: Tensor
    ) -> tuple[Tensor, ...]:
        """Element parameters as the kernels read them, see this module's docstring.

        Args:
            youngs_modulus: E, (num_elements,) or scalar [Pa], > 0.
            poissons_ratio: nu, (num_elements,) or scalar [-], in (-1, 0.5); pd: [0, 0.5).
            **constants: What the law reads besides, by the names of ``CONSTANTS``.

        Returns:
            The weights of the law in their order [Pa]. Gradients: all constants.
        """
        if self.law == "pd":
            return pd_weights(youngs_modulus, poissons_ratio, self.volume_weight)
        lame = lame_parameters(youngs_modulus, poissons_ratio)
        if self.law == "mooney_rivlin":
            return mooney_rivlin_weights(lame, **constants)
        return SolidWeights(w_mu=2.0 * lame.mu, w_vol=lame.lame_lambda)


def lame_parameters(youngs_modulus: Tensor, poissons_ratio: Tensor) -> LameParameters:
    """Lame parameters of a linear elastic solid.

    lame_mu = E / (2 (1 + nu)),  lame_lambda = E nu / ((1 + nu)(1 - 2 nu)).

    Args:
        youngs_modulus: E, any shape [Pa], > 0.
        poissons_ratio: nu, broadcastable [-], in (-1, 0.5).

    Returns:
        mu and lambda [Pa]. Gradients: both arguments.

    Raises:
        ValueError: out of range.
    """
    check_elastic(youngs_modulus, poissons_ratio)
    mu = youngs_modulus / (2.0 * (1.0 + poissons_ratio))
    lame_lambda = (
        youngs_modulus * poissons_ratio / ((1.0 + poissons_ratio) * (1.0 - 2.0 * poissons_ratio))
    )
    return LameParameters(mu=mu, lame_lambda=lame_lambda)


def small_strain_moduli(law: str, weights: Tensor) -> SmallStrain:
    """What the weights of a law stand for at small strain, where all laws are alike.

    Args:
        law: One of ``MATERIALS``.
        weights: Weights of each element, (..., num_weights, num_elements) [Pa].

    Returns:
        2 mu and lambda, (..., num_elements) [Pa]; linear in the weights.
    """
    w_mu, w_vol, *others = weights.unbind(-2)
    if law == "mooney_rivlin":
        return SmallStrain(two_mu=w_mu + others[0], lame_lambda=w_vol)
    return SmallStrain(two_mu=w_mu, lame_lambda=w_vol / 3.0 if law == "pd" else w_vol)


def pd_weights(
    youngs_modulus: Tensor, poissons_ratio: Tensor, volume_weight: str = "small_strain"
) -> SolidWeights:
    """Weights of the corotated and volume energies (thesis eq. 4.12).

    psi(F) = w_mu/2 |F - R|^2 + w_vol/2 |F - B|^2,  w_mu = 2 lame_mu.

    The nearest matrix of determinant one to F = I + e is B = I + e - tr(e)/3 I, so the volume term
    is w_vol/6 tr(e)^2 at small strain, where linear elasticity has lame_lambda/2 tr(e)^2:

    * ``"small_strain"``: w_vol = 3 lame_lambda; small strains follow linear elasticity with the
      constants given (E, nu in = E, nu out).
    * ``"thesis"``: w_vol = lame_lambda, as published; nu = 0.45 then behaves as 0.375 and E as
      0.948 E. For comparison with published numbers.

    Args:
        youngs_modulus: E, (num_elements,) or scalar [Pa].
        poissons_ratio: nu, (num_elements,) or scalar [-]; must be >= 0, since a negative weight has
            no minimum.
        volume_weight: One of the two conventions, ``small_strain`` or ``thesis``.

    Returns:
        (w_mu, w_vol) [Pa]. Gradients: both arguments.
    """
    require_choice("volume_weight", volume_weight, VOLUME_WEIGHTS)
    lame = lame_parameters(youngs_modulus, poissons_ratio)
    if not torch.compiler.is_compiling():
        require_range(
            "poissons_ratio",
            poissons_ratio,
            at_least=0.0,
            hint="the projective-dynamics volume energy needs a non-negative weight; other "
            "materials, such as 'stable_neo_hookean', take nu in (-1, 0.5)",
        )
    share = 3.0 if volume_weight == "small_strain" else 1.0
    return SolidWeights(w_mu=2.0 * lame.mu, w_vol=share * lame.lame_lambda)


def mooney_rivlin_weights(lame: LameParameters, second_share: Tensor) -> tuple[Tensor, ...]:
    """4 c1, lambda and 4 c2 of the energy in this module's docstring [Pa]; all have gradients."""
    if not torch.compiler.is_compiling():
        require_range("second_share", second_share, at_least=0.0, at_most=1.0)
    second = 2.0 * lame.mu * second_share
    return 2.0 * lame.mu - second, lame.lame_lambda, second


def check_elastic(youngs_modulus: Tensor, poissons_ratio: Tensor) -> None:
    """Refuse constants that no stable isotropic solid has."""
    if torch.compiler.is_compiling():
        return
    require_range("youngs_modulus", youngs_modulus, above=0.0, hint="unit is Pa")
    require_range(
        "poissons_ratio",
        poissons_ratio,
        above=-1.0,
        below=0.5,
        hint="for nearly incompressible use 0.49",
    )
