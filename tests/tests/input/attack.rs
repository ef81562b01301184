//! A quarter of a second for every reader with damaged files; `.ci/run` and `scripts/check/attack.sh` attack for longer.

use std::process::Command;

#[test]
fn damaged_files_neither_crash_nor_hang_readers() {
    let findings = tempfile::tempdir().expect("a temporary folder");
    let output = Command::new(env!("CARGO_BIN_EXE_clift-attack"))
        .args(["--seconds", "0.25", "--seed", "1", "--findings"])
        .arg(findings.path())
        .output()
        .expect("the attacker starts");
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{said}\n{}", String::from_utf8_lossy(&output.stderr));
    assert!(said.lines().filter(|line| line.contains(" executions in ")).count() > 25, "{said}");
}
