"""People in pictures from the ground, by HOG and a linear SVM."""
