"""Many steps in a row: which way they go, and the ways."""

from .fused_op import substeps_arguments
from .plan import RolloutPlan, plan_rollout
from .run import rollout

__all__ = ["RolloutPlan", "plan_rollout", "rollout", "substeps_arguments"]
