"""Job kinds that tell people and other programs: reports, exports, the comparison with the truth."""
