"""Fig. 6: fixed against learnt β (lis against lis-b) where highlights are occluded.

    python scripts/figures/fig6.py

Writes fig6.png, crops of both beside the reference with their MAPE, and fig6.json.
"""

from common import compared, figure_options, run, write_numbers

from bokehguide.evaluation.crops_figure import write_crops


def main() -> None:
    options = figure_options(__doc__, ["occluded"])
    comparisons = compared(["lis", "lis-b"], options)
    write_crops(options.out / "fig6.png", comparisons)
    write_numbers(comparisons, options.out / "fig6.json")
    print(f"wrote {options.out / 'fig6.png'} and .json")


if __name__ == "__main__":
    run(main)
