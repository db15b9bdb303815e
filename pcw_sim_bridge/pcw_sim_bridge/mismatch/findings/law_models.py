"""Laws outside the library as models: where they stand in a fit, in the problem of other recordings, and in a simulation."""

from __future__ import annotations

from collections.abc import Container

from pcw_description.effect_instance import EffectInstance
from pcw_description.effects.effect import Effect
from pcw_description.effects.registry import all_effects

from ..laws.generated_effect import GeneratedEffect, NoSuchKernelError, generate, parameters_of
from ..laws.unknown_law import Law
from ..regression.regression_problem import UNKNOWN, FloatArray, RegressionProblem
from ..regression.whitened_regression import Instance
from .explanation import Explanation


class LawModels:
    """The laws that the fit of an explanation holds and that are to be modelled, by instance.

    Attributes:
        laws: every law.
        without_kernel: why simulators cannot have a law, for those that they cannot.
    """

    def __init__(self, explanation: Explanation, refused: Container[Instance] = ()) -> None:
        """Find the laws but for those refused, and make each an effect if the kernel of one can hold it."""
        self.laws: dict[Instance, Law] = {}
        self.without_kernel: dict[Instance, str] = {}
        self._made: dict[Instance, GeneratedEffect] = {}
        terms = explanation.search.problem.terms
        for instance in explanation.selection.fit.instances:
            term = terms[instance.term]
            is_law = term.effect == UNKNOWN and instance not in refused
            for left in explanation.leftovers if is_law else ():
                if left.law is None or term.law is not left.law:
                    continue
                self.laws[instance] = left.law
                taken = [*all_effects(), *(made.name for made in self._made.values())]
                try:
                    self._made[instance] = generate(left.law, left.weights, (), taken)
                except NoSuchKernelError as error:
                    self.without_kernel[instance] = str(error)

    @property
    def effects(self) -> list[Effect]:
        """The laws that simulators can have."""
        return [made.loaded for made in self._made.values()]

    def in_problem(self, other: RegressionProblem) -> RegressionProblem:
        """The problem of other recordings with the laws as further terms; as it is where it has no sites."""
        if other.sites is None or not self.laws:
            return other
        names = set(other.sites.variables)
        return other.with_terms([law.term(other) for law in self.laws.values() if set(law.depends_on) <= names])

    def simulated(self, instance: Instance, weights: FloatArray) -> EffectInstance | None:
        """A law with weights (K,) as it stands under `physics:`; None where simulators cannot have it."""
        if instance not in self._made:
            return None
        made = self._made[instance]
        return EffectInstance(made.name, made.target, parameters_of(self.laws[instance].basis, weights), None)
