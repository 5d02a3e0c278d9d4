"""Makes Python modules of kinova_msgs with ROS' own generators: messages.py DIRECTORY."""

import pathlib
import subprocess
import sys

SOURCE = pathlib.Path(__file__).parent / "kinova_msgs"
GENERATORS = "/usr/lib/genpy"
# What ROS makes of an action, besides its goal, result and feedback.
ACTION = {
    "ActionGoal": "Header header\nactionlib_msgs/GoalID goal_id\n{0}Goal goal\n",
    "ActionResult": "Header header\nactionlib_msgs/GoalStatus status\n{0}Result result\n",
    "ActionFeedback": "Header header\nactionlib_msgs/GoalStatus status\n{0}Feedback feedback\n",
    "Action": "{0}ActionGoal action_goal\n{0}ActionResult action_result\n{0}ActionFeedback action_feedback\n",
}


def generate(directory):
    """Writes the package kinova_msgs below a directory."""
    fields = directory / "fields"
    fields.mkdir(parents=True)
    for path in SOURCE.glob("msg/*.msg"):
        (fields / path.name).write_text(path.read_text())
    for path in SOURCE.glob("action/*.action"):
        for part, text in zip(["Goal", "Result", "Feedback"], path.read_text().split("---\n")):
            (fields / f"{path.stem}{part}.msg").write_text(text)
        for part, text in ACTION.items():
            (fields / f"{path.stem}{part}.msg").write_text(text.format(path.stem))
    package = directory / "kinova_msgs"
    package.mkdir()
    (package / "__init__.py").touch()
    run("genmsg_py.py", fields, package / "msg", sorted(fields.glob("*.msg")))
    run("gensrv_py.py", fields, package / "srv", sorted(SOURCE.glob("srv/*.srv")))


def run(generator, fields, out, files):
    out.mkdir()
    known = {"kinova_msgs": fields, "std_msgs": "/usr/share/std_msgs/msg", "actionlib_msgs": "/usr/share/actionlib_msgs/msg"}
    command = [sys.executable, f"{GENERATORS}/{generator}", "-p", "kinova_msgs", "-o", out]
    command += [f"-I{name}:{path}" for name, path in known.items()]
    subprocess.run(command + files, check=True)
    subprocess.run([sys.executable, f"{GENERATORS}/{generator}", "--initpy", "-p", "kinova_msgs", "-o", out], check=True)


if __name__ == "__main__":
    generate(pathlib.Path(sys.argv[1]))
