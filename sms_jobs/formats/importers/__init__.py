"""Readers of what other people measured: folders of images, tables of readings. Nothing is written here."""
