"""From the electric fields of antennas to the beam of every correlation product."""
