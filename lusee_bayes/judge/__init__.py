"""Do data and model agree, who disagrees, and does the error bar cover."""
