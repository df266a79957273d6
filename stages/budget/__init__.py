"""Budget: what a perturbed model does to tracks and spectra, part by part, beside what noise alone does.

The perturbations are functions of records; how tracks and spectra come of them is the business of tracking and
reconstruction, which a flow calls in between:

perturbed records → (tracking, reconstruction) → compare → one `Comparison` a line → run → the table
"""

from stages.budget.comparison import Comparison, Variant, compare, least_noise, terrain_displacement
from stages.budget.control import Control, fit_control
from stages.budget.perturbations import as_targets, displaced, later, raised, random_walk, turned
from stages.budget.settings import BudgetSettings
from stages.budget.table import BudgetResult, Part, run

__all__ = [
    "BudgetResult",
    "BudgetSettings",
    "Comparison",
    "Control",
    "Part",
    "Variant",
    "as_targets",
    "compare",
    "displaced",
    "fit_control",
    "later",
    "least_noise",
    "raised",
    "random_walk",
    "run",
    "terrain_displacement",
    "turned",
]
