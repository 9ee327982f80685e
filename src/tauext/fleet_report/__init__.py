"""What a hundred arms say together: which joint is wearing, which arm has another tool or torque constant."""

from tauext.fleet_report.stage import FILE, make_fleet_report

__all__ = ["FILE", "make_fleet_report"]
