"""Waterfalls in luseepy's layouts: visibilities of all times, products and frequencies."""

from lusee_bayes.instrument.waterfalls.files import read_waterfall
from lusee_bayes.instrument.waterfalls.scalar import write_waterfall
from lusee_bayes.instrument.waterfalls.waterfall import Waterfall

__all__ = ["Waterfall", "read_waterfall", "write_waterfall"]
