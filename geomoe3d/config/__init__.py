"""Typed, frozen configuration; YAML files hold the same tree (see configs/).

`sections` holds what a user may want to change, part by part, `expert` every other number that decides an answer.
"""

from geomoe3d.config.expert import ExpertConfig, expert, expert_in_force, expert_of_argument, in_force
from geomoe3d.config.reading import build_config, known_keys, load_config, read_yaml, set_keys, yaml_text
from geomoe3d.config.section import Section
from geomoe3d.config.sections import (
    DecisionConfig,
    DescriptorConfig,
    EstimatorConfig,
    FilterConfig,
    MatchingConfig,
    PartConfig,
    PreparationConfig,
    RefinementConfig,
    RegistrationConfig,
    ScoringConfig,
    SecondLookConfig,
)

__all__ = [
    "DecisionConfig",
    "DescriptorConfig",
    "EstimatorConfig",
    "ExpertConfig",
    "FilterConfig",
    "MatchingConfig",
    "PartConfig",
    "PreparationConfig",
    "RefinementConfig",
    "RegistrationConfig",
    "ScoringConfig",
    "SecondLookConfig",
    "Section",
    "build_config",
    "expert",
    "expert_in_force",
    "expert_of_argument",
    "in_force",
    "known_keys",
    "load_config",
    "read_yaml",
    "set_keys",
    "yaml_text",
]
