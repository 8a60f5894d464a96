"""The benchmark of what free space costs: every situation has its figures, and a scan weighs more than a map."""

from deploy.bench import perception


def test_a_scan_weighs_kilobytes_and_a_map_hundreds_of_bytes(data_folder, monkeypatch):
    monkeypatch.setattr(perception, "POLICIES", ("random",))
    names = ("map", "scan", "fleet of 2")
    monkeypatch.setattr(perception, "SITUATIONS", {name: perception.SITUATIONS[name] for name in names})
    monkeypatch.setattr(perception, "WARM_UP", 0)
    figures = perception.run(6)
    alone, scan, fleet = (figures[name]["request p50 B"] for name in names)
    assert 300 < alone < fleet < 1000 < 3000 < scan < 5000
    assert all(row["answer p50 ms"] > 0.0 and row["reply p50 B"] > 200 for row in figures.values())
