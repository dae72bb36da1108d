"""The scene graph: layers, activities and goals, what changed, and questions to it."""
