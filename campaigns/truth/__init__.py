"""Planted faults: do the reports of ``rsltrace diff`` say what is true? (``make truth``)"""
