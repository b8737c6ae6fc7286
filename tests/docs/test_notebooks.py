"""Notebooks are stored as they ran, and run on any machine. Their execution is a step of CI."""

import ast
import json
import re

import pytest
from paths import REPO

NOTEBOOKS = sorted((REPO / "notebooks").glob("*.ipynb"))
LARGEST = 600_000
"""Bytes."""

_SHOWS = re.compile(r"\b(print|display|show|draw_map|headline|comparison_text|TextTable|Markdown)\(")
_ABSOLUTE = re.compile(r"(?<![\w.~:/])/(home|root|tmp|work|usr|opt|Users|var|mnt)/")


def code_cells(path):
    return [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]


def source(cell):
    return "".join(cell["source"])


def test_there_are_seven():
    assert [path.name[:2] for path in NOTEBOOKS] == ["01", "02", "03", "04", "05", "06", "07"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
class TestNotebook:
    def test_is_a_plain_python_notebook_of_moderate_size(self, path):
        metadata = json.loads(path.read_text())["metadata"]
        assert metadata["kernelspec"]["name"] == "python3"
        assert set(metadata) == {"kernelspec", "language_info"}
        assert path.stat().st_size < LARGEST

    def test_begins_with_a_title(self, path):
        first = json.loads(path.read_text())["cells"][0]
        assert first["cell_type"] == "markdown" and "".join(first["source"]).startswith("# ")

    def test_code_parses(self, path):
        for cell in code_cells(path):
            ast.parse(source(cell))

    def test_was_run_in_order_and_whole(self, path):
        assert [cell["execution_count"] for cell in code_cells(path)] == [
            *range(1, len(code_cells(path)) + 1)
        ]
        for cell in code_cells(path):
            assert "execution" not in cell["metadata"], "times of execution"
            # what only a function shows is not shown by its cell
            top = [node for node in ast.parse(source(cell)).body if not isinstance(node, ast.FunctionDef)]
            if any(_SHOWS.search(ast.unparse(node)) for node in top):
                assert cell["outputs"], source(cell)

    def test_outputs_are_clean(self, path):
        for cell in code_cells(path):
            for output in cell["outputs"]:
                assert output["output_type"] != "error", output
                assert output.get("name") != "stderr", output
                text = json.dumps({k: v for k, v in output.get("data", {}).items() if "image" not in k})
                text += "".join(output.get("text", ()))
                assert not _ABSOLUTE.search(text) and "Warning" not in text, text[:300]

    def test_hides_false_alarms_before_jax_is_imported(self, path):
        """What XLA writes about programs from its cache would be in the cells of every second run."""
        first = source(code_cells(path)[0])
        assert 'os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"' in first
        assert "import" not in first.replace("import os\n", "", 1)

    def test_has_figures_with_captions(self, path):
        cells = json.loads(path.read_text())["cells"]
        pictures = sum("image/png" in out.get("data", {}) for c in code_cells(path) for out in c["outputs"])
        captions = sum("**Figure" in "".join(cell["source"]) for cell in cells)
        assert 0 < captions <= pictures

    def test_names_no_place_of_one_machine(self, path):
        for cell in json.loads(path.read_text())["cells"]:
            assert not _ABSOLUTE.search(source(cell)), source(cell)
