// Exchanges the token for a cookie that scripts cannot read.
const form = document.getElementById("login");
const message = document.getElementById("login-error");

form.addEventListener("submit", async (event) => {
  event.preventDefault();
  const token = document.getElementById("token").value.trim();
  try {
    const headers = { authorization: `Bearer ${token}`, "x-tandem-action": "login" };
    const response = await fetch("/login", { method: "POST", headers });
    if (response.ok) location.reload();
    else message.textContent = "The token is wrong.";
  } catch {
    message.textContent = "The service does not answer.";
  }
});
