if __name__ == "__main__":
    import sys

    from services.estimating import Estimating
    from services.process import main, stages

    sys.exit(main("preprocessing", stages(Estimating)))
