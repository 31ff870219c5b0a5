"""Waterfalls in luseepy's layouts: visibilities of all times, products and frequencies."""

from lusee_bayes.instrument.waterfalls.files import read_waterfall
from lusee_bayes.instrument.waterfalls.four_port_writing import write_four_port
from lusee_bayes.instrument.waterfalls.waterfall import Waterfall
from lusee_bayes.instrument.waterfalls.writing import write_waterfall

__all__ = ["Waterfall", "read_waterfall", "write_four_port", "write_waterfall"]
