"""Implicit steps: where they converge, what they cost, and how wrong they are.

    python -m benchmarks.implicit             # all studies, some 20 minutes on 2 cores
    python -m benchmarks.implicit --only cost
    python -m benchmarks.implicit --quick     # seconds

Each study is a module of this package, whose docstring says what is done.
"""
def section(title: str, rows: list[dict[str, Any]]) -> str:
    return f"## {title}\n\n" + common.table(list(rows[0]), [list(row.values()) for row in rows])


def text(result: dict[str, Any]) -> str:
    lines = ["# Implicit steps", common.describe(result["environment"]), (__doc__ or "").split("\n\n", 1)[1].strip()]
    titles = {"stability": "Stability", "work": "Work and precision", "cohesion": "Cohesion of sand",
              "cost": "Cost, in units of a gather and a scatter", "batches": "Batches"}  # fmt: skip
    return "\n\n".join([*lines, *(section(title, result[key]) for key, title in titles.items() if key in result)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few and small cases, to see that it works")
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--out", type=Path, default=common.RESULTS)
    arguments = parser.parse_args()
    quick, device = arguments.quick, arguments.device
    result: dict[str, Any] = {"environment": common.environment(device)}
    if device == "cpu":
        result |= {"stability": stability(quick), "work": work(quick), "cohesion": cohesion()}
    result |= {"cost": cost(device, quick), "batches": batches(device, quick)}
    print(text(result))
    name = "implicit" if quick else f"implicit_{common.slug(common.device_name(device))}"
    common.write(arguments.out, name, result, text(result))


if __name__ == "__main__":
    main()
