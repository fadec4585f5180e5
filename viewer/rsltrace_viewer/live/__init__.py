"""``rsltrace view --live``: the selected event is executed again, and shown with what it did."""
