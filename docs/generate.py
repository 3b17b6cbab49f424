"""Rewrite config/*.yaml and the tables of parameters in README.md and docs/: `make generate`."""

from pathlib import Path

from gp_ground_seg.parameters.export import README_PATH, generated_files

ROOT = Path(__file__).resolve().parent.parent

for name, text in generated_files((ROOT / README_PATH).read_text(encoding='utf-8')).items():
    (ROOT / name).write_text(text, encoding='utf-8')
