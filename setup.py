"""Puts the graphs and the demo recording into the installed package; everything else is said in pyproject.toml."""

from __future__ import annotations

from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py


class BuildWithShipped(build_py):
    """Copies `graphs/` and `recordings/` to `dataflow/shipped/`. An editable install reads them where they are."""

    def run(self) -> None:
        super().run()
        if not self.editable_mode:
            for source, target in self._shipped().items():
                self.mkpath(str(Path(target).parent))
                self.copy_file(source, target)

    def get_outputs(self, include_bytecode: bool = True) -> list[str]:
        return [*super().get_outputs(include_bytecode), *self._shipped().values()]

    def _shipped(self) -> dict[str, str]:
        files = [*sorted(Path("graphs").rglob("*.yaml")), *sorted(Path("recordings").glob("*.mcap"))]
        return {str(file): str(Path(self.build_lib, "dataflow", "shipped", file)) for file in files}


setup(cmdclass={"build_py": BuildWithShipped})
