"""Label spaces: what the classes of a detector are, in YAML files; no code elsewhere names a class."""

from operators.labels.label_space import ROLES, LabelSpace, LabelSpaceError, SizePrior, labels_file

__all__ = ["ROLES", "LabelSpace", "LabelSpaceError", "SizePrior", "labels_file"]
