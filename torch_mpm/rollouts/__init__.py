"""Rollouts: the plan of many steps, and the executors that compute them."""

from .fused_op import substeps_arguments
from .plan import RolloutPlan, plan_rollout
from .run import rollout

__all__ = ["RolloutPlan", "plan_rollout", "rollout", "substeps_arguments"]
