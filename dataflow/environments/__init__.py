"""Virtual environments of operators: packages of other versions than those of this installation."""

from dataflow.environments.environment import (
    EnvError,
    Environment,
    environment_of,
    imported_packages,
    in_same,
    installed,
    is_environment,
    packages_in,
    require_environment,
)

__all__ = [
    "EnvError",
    "Environment",
    "environment_of",
    "imported_packages",
    "in_same",
    "installed",
    "is_environment",
    "packages_in",
    "require_environment",
]
