"""Tests: do data and model agree, which parts disagree, and do error bars cover the truth."""
