"""Figures and one self-contained page from results, estimates and recordings; it computes nothing but what it draws."""

from tauext.report.fleet_write import write_fleet_page
from tauext.report.flight import write_flight_report
from tauext.report.write import write_report

__all__ = ["write_fleet_page", "write_flight_report", "write_report"]
