"""Print the table of the search for settings from search/*.csv: success in training by frames.

    python results/search.py

A cell is the mean of the 25 updates (100 000 frames) up to that point, axis-aligned, sampled
actions, at N = 2; empty if the run had been stopped before.
"""
import csv
import glob
import os

HERE = os.path.dirname(os.path.abspath(__file__))
POINTS = (0.3, 1.0, 1.6, 2.0, 3.0, 5.0)                        # million frames
WINDOW = 100_000                                               # frames


def curve(path):
    """[(frames, success)] of a progress.csv."""
    with open(path, newline="") as file:
        return [(int(row["frames"]), float(row["success_aabb"])) for row in csv.DictReader(file)]


def success_at(points, frames):
    """Mean success of the WINDOW before `frames` as text; empty if the run is not so long."""
    if points[-1][0] < frames:
        return ""
    values = [success for at, success in points if frames - WINDOW < at <= frames]
    return f"{sum(values) / len(values):.2f}"


def main():
    print("| run | " + " | ".join(f"{point} M" for point in POINTS) + " |")
    print("|---" * (1 + len(POINTS)) + "|")
    for path in sorted(glob.glob(os.path.join(HERE, "search", "*.csv"))):
        points = curve(path)
        cells = [success_at(points, point * 1e6) for point in POINTS]
        print(f"| {os.path.basename(path)[:-4]} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
