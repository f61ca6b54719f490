"""Who is there: the people of a recording, from the detections of all cameras."""
