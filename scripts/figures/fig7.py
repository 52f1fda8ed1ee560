"""Fig. 7: fixed Gaussians and Gaussians shifted by polynomials (lis-b and lis-o), on chrome.

    python scripts/figures/fig7.py

Writes fig7.png, crops of both beside the reference with their MAPE, fig7.md and fig7.json.
"""

from common import compared, figure_options, write_numbers

from bokehguide.cli.scripts import run
from bokehguide.evaluation.crops_figure import write_crops


def main() -> None:
    options = figure_options(__doc__, ["chrome"])
    comparisons = compared(["lis-b", "lis-o"], options)
    write_crops(options.out / "fig7.png", comparisons)
    write_numbers(comparisons, options.out / "fig7.json")
    print(f"wrote {options.out / 'fig7.png'} and .json")


if __name__ == "__main__":
    run(main, "finished renders are kept, and the same command continues")
